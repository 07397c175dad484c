"""Explains what is wrong with arguments and values, in one line that names what was typed, what is allowed and what was probably meant."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import ValidationError

from gpe_pl.config.folder import CONF
from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import did_you_mean
from gpe_pl.files.names import NameRefused


class ConfigError(GpeError, ValueError):
    """Raised for a config value that is not allowed; the message names key, value and the allowed values."""


REFUSALS = (NameRefused.__name__, ConfigError.__name__)
"""Errors that a ``${…}`` in a configuration can raise and whose message is complete. What OmegaConf adds to such a message is dropped."""

VIOLATIONS = {
    "bool_parsing": "must be true or false",
    "bool_type": "must be true or false",
    "dict_type": "must be a table, such as {{key: value}}",
    "finite_number": "must be a finite number",
    "float_parsing": "must be a number",
    "float_type": "must be a number",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "int_from_float": "must be an integer",
    "int_parsing": "must be an integer",
    "int_type": "must be an integer",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "list_type": "must be a list, such as [1,2]",
    "literal_error": "must be {expected}",
    "missing": "is missing; give it a value",
    "string_type": "must be text",
    "too_short": "must have at least {min_length} values",
    "tuple_type": "must be a list, such as [1,2]",
}
"""Message for each kind of violation that pydantic reports, with the names of its context."""


LIKELY = ("training", "model", "evaluation", "graph", "data", "trainer", "suite")
"""Parts of a configuration in which a key without a part is looked for, in this order."""


def violations(error: ValidationError, path: str) -> str:
    """Describe values that do not fit a signature, in one line.

    Args:
        error: the violations.
        path: key of the settings.
    """
    parts = []
    for e in error.errors():
        key = ".".join([*([path] if path else []), *(str(k) for k in e["loc"] if isinstance(k, (str, int)))])
        value = f"={e['input']!r}" if e["loc"] and e["type"] != "missing" and not isinstance(e["input"], dict) else ""
        message = e["msg"].removeprefix("Value error, ")
        message = message if message[:2].isupper() else message[0].lower() + message[1:]
        known = VIOLATIONS.get(e["type"], message.replace("{", "{{").replace("}", "}}")).format(**e.get("ctx", {}))
        meant = did_you_mean(str(e["input"]), re.findall(r"'([^']*)'", known)) if e["type"] == "literal_error" else ""
        parts.append(f"{key}{value}: {known}{meant}")
    return "; ".join(dict.fromkeys(parts))


def check_arguments(arguments: Sequence[str], config_name: str) -> None:
    """Raise ``ConfigError`` for an argument that is neither an option of Hydra nor ``KEY=VALUE``; the message says what to write instead."""
    options = {name: action.nargs != 0 for action in get_args_parser()._actions for name in action.option_strings}
    waiting = list(arguments)
    while waiting:
        argument = waiting.pop(0)
        following = waiting[0] if waiting else ""
        if argument.startswith("-"):
            name, equals, value = argument.partition("=")
            if name not in options:
                key = name.lstrip("-").replace("-", "_")
                value = value if equals else following if following and following[0] not in "-~+" and "=" not in following else "…"
                raise ConfigError(
                    f"{argument}{'' if equals or value == '…' else f' {value}'}: settings have no dashes; write {key}={value}"
                )
            if options[name] and not equals and waiting:
                waiting.pop(0)
        elif following == "=" or (argument.endswith("=") and following and "=" not in following and following[0] not in "-~+"):
            value = waiting[1] if following == "=" and len(waiting) > 1 else following.strip("=")
            raise ConfigError(f"{argument} {following}: write {argument.rstrip('=')}={value or '…'} without spaces")
        elif "=" not in argument and not argument.startswith("~"):
            raise ConfigError(f"{argument}: {_meant(argument, following, config_name)}")


def _meant(word: str, following: str, config_name: str) -> str:
    """Say what a word without ``=`` should probably have been."""
    if ":" in word:
        return f"write {word.replace(':', '=', 1)}"
    if word in keys_of(config_name):
        return f"write {word}={following if following and '=' not in following and following[0] not in '-~+' else '…'}"
    offering = [group for group in sorted(groups(config_name)) if (CONF / group / f"{word}.yaml").is_file()]
    if offering:
        return f"write {' or '.join(f'{group}={word}' for group in offering)}"
    return f"settings are KEY=VALUE{did_you_mean(word, keys_of(config_name))}; `--help` lists the keys"


def refusal(error: Exception) -> str | None:
    """Return the message of a resolver in ``REFUSALS`` without what OmegaConf adds to it; None for other errors."""
    text = " ".join(str(error).split())
    if any(f"{name} raised" in text for name in REFUSALS):
        return re.sub(r"^.*? raised while resolving interpolation: | full_key: .*", "", text)
    return None


def explain(error: Exception, config_name: str, overrides: list[str]) -> str:
    """Explain a composition error in one line, with the valid keys or choices."""
    if (known := refusal(error)) is not None:
        return known
    text = " ".join(str(error).split())
    if "'data/imported'" in text:
        return f"data=imported: {config_name} takes data that it simulates; fit and evaluate take imported ones"
    if missing := re.search(r"Could not find '([^']+)'.*?Available options in '[^']+': ([\w ]*?)(?: Config search path:|$)", text):
        group, _, choice = missing[1].rpartition("/")
        return f"{group}={choice}: no such choice{did_you_mean(choice, missing[2].split())}; choices: {', '.join(missing[2].split())}"
    if "must be a string or a list" in text:
        return f"{_not_named(config_name, overrides)}: must be the name of a choice; `--help` lists them"
    match = re.search(r"Could not override '([^']+)'", text)
    if match is None:
        return _syntax(error, text)
    key = match.group(1).partition("@")[0].lstrip("+~")
    parent, _, leaf = key.rpartition(".")
    if key.startswith("hydra."):
        return text
    others = [
        first_choice(o) for o in overrides if "=" in o and not o.startswith(("-", "hydra")) and o.partition("=")[0].lstrip("+~") != key
    ]
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            composed: Any = hydra.compose(config_name, others)
    except (HydraException, OmegaConfBaseException):
        return text
    while parent and not isinstance(OmegaConf.select(composed, parent), DictConfig):
        parent = parent.rpartition(".")[0]  # the misspelt part is further up in the key
        leaf = key.removeprefix(f"{parent}.").partition(".")[0]
    node = OmegaConf.select(composed, parent) if parent else composed
    if not parent and "." in key and leaf in groups(config_name):
        nested = next((place for place in _places(composed, "") if place.endswith(f".{key}")), None)
        meant = f"; did you mean {nested!r}?" if nested else ""
        return f"{key}: {leaf!r} is the name of a choice and has no keys, write {leaf}=CHOICE{meant}"
    keys = sorted({*map(str, node), *(() if parent else groups(config_name))})
    elsewhere = [
        place for part in LIKELY if part in composed for place in _places(composed[part], f"{part}.") if place.rpartition(".")[2] == key
    ]
    meant = f"; did you mean {elsewhere[0]!r}?" if elsewhere else did_you_mean(leaf, keys)
    return f"{key}: unknown key {leaf!r}{meant}; valid keys{f' of {parent}' if parent else ''}: {', '.join(keys)}"


def _syntax(error: Exception, text: str) -> str:
    """Explain an override that Hydra cannot read, without the words of its parser."""
    override = getattr(error, "override", None)  # syntax errors have it
    text = re.sub(r" ?Config search path:.*| ?Set the environment variable.*| See https://.*", "", text)
    if override is None:
        return text
    key = str(override).partition("=")[0]
    if override.count("=") > 1:
        return f"{override}: a value that holds = needs quotes: 'KEY=\"VALUE\"'"
    return (
        f"{override}: cannot be read; write lists as '{key}=[A,B]', tables as '{key}={{A: 1}}', and other text in quotes: '{key}=\"TEXT\"'"
    )


def _not_named(config_name: str, overrides: Sequence[str]) -> str:
    """Return the first override whose key is a group and whose value is no name."""
    for override in overrides:
        key, _, value = override.partition("=")
        if key.lstrip("+") in groups(config_name) and not re.fullmatch(r"[A-Za-z_][\w,/]*|null", value):
            return override
    return ", ".join(overrides)


def _places(node: Any, path: str = "") -> Iterator[str]:
    """Yield the keys of all values of a configuration."""
    for key in node:
        child = None if OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key) else node[key]
        yield f"{path}{key}"
        if isinstance(child, DictConfig):
            yield from _places(child, f"{path}{key}.")


def first_choice(override: str) -> str:
    """Reduce a sweep override to the first of its values."""
    parsed = OverridesParser.create().parse_override(override)
    return f"{override.partition('=')[0]}={next(parsed.sweep_string_iterator())}" if parsed.is_sweep_override() else override


def groups(config_name: str) -> set[str]:
    """Return the config groups of a command."""
    defaults = OmegaConf.load(CONF / f"{config_name}.yaml").defaults
    return {str(group) for entry in defaults if isinstance(entry, DictConfig) for group in entry if "/" not in str(group)}


def keys_of(config_name: str) -> set[str]:
    """Return the groups of a command, and the keys in its file."""
    return {*groups(config_name), *map(str, OmegaConf.load(Path(CONF) / f"{config_name}.yaml"))} - {"defaults", "hydra"}
