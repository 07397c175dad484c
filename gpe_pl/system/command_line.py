"""Commands without a Hydra configuration: one word and a few ``KEY=VALUE``, with errors in one line."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import clean_messages, did_you_mean, one_line, speak_utf8
from gpe_pl.system import early_interrupts

STATUS = 2
"""Exit status of a command that ends with an error."""


class ArgumentFault(GpeError, ValueError):
    """Raised for an argument that a command does not take; the message names it and says what it takes."""


def command(
    task: Callable[[str | None, dict[str, Any]], None], about: str, word: str, keys: Mapping[str, Callable[[str], Any]]
) -> Callable[[], None]:
    """Return the main function of a command.

    Args:
        task: called with the word (None if it is missing) and the given values by key.
        about: text of ``--help``.
        word: name of the argument that is not ``KEY=VALUE``, for messages.
        keys: known keys, each with the function that reads its value and raises ``ValueError`` with a message that begins with "must be".
    """

    def main() -> None:
        early_interrupts.end()
        speak_utf8()
        clean_messages()
        logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING)
        if {"-h", "--help"} & set(sys.argv[1:]):
            print(about)
            return
        try:
            task(*parsed(sys.argv[1:], word, keys))
        except KeyboardInterrupt:
            print(early_interrupts.NOTICE, file=sys.stderr)
            sys.exit(early_interrupts.STATUS)
        except (GpeError, OSError) as error:
            print(f"error: {one_line(str(error))}", file=sys.stderr)
            sys.exit(STATUS)

    return main


def parsed(arguments: Sequence[str], word: str, keys: Mapping[str, Callable[[str], Any]]) -> tuple[str | None, dict[str, Any]]:
    """Return the word among some arguments, and the values of the others by key.

    Raises:
        ArgumentFault: there are two words, a key is unknown, or a value is not allowed.
    """
    words: list[str] = []
    values: dict[str, Any] = {}
    listed = f"keys: {', '.join(keys)}"
    for argument in arguments:
        key, equals, value = argument.lstrip("-").partition("=")
        if argument.startswith("-"):
            raise ArgumentFault(f"{argument}: settings have no dashes; write {key}={value or '…'} ({listed})")
        if not equals or (key not in keys and ("/" in key or Path(argument).exists())):  # folders of sweeps have names such as seed=0
            words.append(argument)
        elif key not in keys:
            raise ArgumentFault(f"{key}: unknown key{did_you_mean(key, keys)}; {listed}")
        else:
            try:
                values[key] = keys[key](value)
            except ValueError as error:
                raise ArgumentFault(f"{argument}: {error}") from None
    if len(words) > 1:
        hint = f"write {words[-2]}={words[-1]}" if words[-2] in keys else f"give one {word}, and settings as KEY=VALUE ({listed})"
        raise ArgumentFault(f"{' '.join(words)}: {hint}")
    return (words[0] if words else None), values


def number(low: float, high: float) -> Callable[[str], float]:
    """Return a reader of numbers from ``low`` to ``high``."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise ValueError(f"must be a number from {low:g} to {high:g}")
        return value

    return read


def integer(low: int, high: int) -> Callable[[str], int]:
    """Return a reader of integers from ``low`` to ``high``."""

    def read(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= high:
            raise ValueError(f"must be an integer from {low} to {high}")
        return int(text)

    return read


def truth(text: str) -> bool:
    """Read ``true`` or ``false``."""
    if text.lower() not in ("true", "false"):
        raise ValueError("must be true or false")
    return text.lower() == "true"
