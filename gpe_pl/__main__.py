"""Console script ``gpe VERB …``, which is also ``python -m gpe_pl VERB …``."""

from __future__ import annotations

import importlib
import os
import runpy
import sys

from gpe_pl.errors.printable import did_you_mean, speak_utf8
from gpe_pl.system import early_interrupts

VERBS: dict[str, tuple[str, str]] = {
    "demo": ("scenes.demo", "show a shipped model beside its solver in the browser"),
    "play": ("scenes.play", "play with a model in the browser: drag, throw, slide its parameter"),
    "info": ("scenes.info", "print what a model was trained for, how accurate and how fast it is"),
    "predict": ("scenes.predict", "roll a model out in a scene of your own"),
    "simulate": ("simulate", "generate a data set with a solver"),
    "fit": ("fit", "train a model, evaluate it and write a report"),
    "evaluate": ("evaluate", "compare rollouts of a trained model with the ground truth"),
    "identify": ("identify", "find material parameters from observed motion, with intervals"),
    "design": ("scenes.design", "move an obstacle until it guides bodies to a target"),
    "convert": ("convert", "import data of other projects, or your own arrays"),
    "benchmark": ("benchmark", "run a suite: times, acceptance, stress tests"),
}
"""Module of each verb below ``gpe_pl``, which also runs as ``python -m gpe_pl.MODULE``, and what it does."""

NAMED = ("demo", "play", "info")
"""Verbs whose first argument can be a shipped model."""

COMPLETION = """_gpe_complete() {
    local word="${COMP_LINE:0:COMP_POINT}"
    word="${word##* }"
    COMPREPLY=($(compgen -o default -W "$(COMP_LINE="${COMP_LINE:0:COMP_POINT}" gpe completion words 2>/dev/null)" -- "$word"))
}
COMP_WORDBREAKS=${COMP_WORDBREAKS//=}
complete -o nospace -o default -F _gpe_complete gpe"""
"""Shell code that completes verbs, groups, choices and keys of ``gpe`` in bash."""


def usage() -> str:
    """Return the verbs, one a line."""
    verbs = "\n".join(f"  {verb:10}{about}" for verb, (_, about) in VERBS.items())
    return (
        f"usage: gpe VERB [KEY=VALUE …]\n\n{verbs}\n\n"
        "`gpe VERB --help` shows the settings of a verb.\n"
        'Tab completion in bash: eval "$(gpe completion)"'
    )


def main() -> None:
    """Run the verb that the first argument names."""
    early_interrupts.catch()
    speak_utf8()
    verb, *arguments = sys.argv[1:] or ["--help"]
    if verb in ("-h", "--help", "help"):
        print(usage())
    elif verb == "completion":
        _complete() if arguments else print(COMPLETION)
    elif verb in VERBS:
        _run(verb, arguments)
    else:
        print(f"error: gpe {verb!a}: unknown verb{did_you_mean(verb, VERBS)}; verbs: {', '.join(VERBS)}", file=sys.stderr)
        sys.exit(2)


def _run(verb: str, arguments: list[str]) -> None:
    sys.argv[1:] = arguments
    runpy.run_module(f"gpe_pl.{VERBS[verb][0]}", run_name="__main__", alter_sys=True)


def _complete() -> None:
    """Print the words that can stand at the end of the line ``$COMP_LINE``: verbs, keys and shipped models, or what Hydra knows of a verb's configuration."""
    words = os.environ.get("COMP_LINE", "").split(" ")[1:]
    if len(words) < 2:
        print(" ".join(VERBS))
    elif words[0] in VERBS and "." in VERBS[words[0]][0]:
        print(" ".join(_words_without_hydra(words[0], words[-1])))
    elif words[0] in VERBS:
        os.environ["COMP_LINE"] = " ".join(["gpe", *words[1:]])
        _run(words[0], ["--shell-completion", "query=bash"])


def _words_without_hydra(verb: str, begun: str) -> list[str]:
    """Return the words that a verb without Hydra may have: its keys, and shipped models where they stand alone or after ``checkpoint=``."""
    from gpe_pl.learned.pretrained import names

    keys = [f"{key}=" for key in importlib.import_module(f"gpe_pl.{VERBS[verb][0]}").KEYS]
    of_models = [f"checkpoint={name}" for name in names()] if "checkpoint=" in keys else names() if verb in NAMED else []
    return [word for word in (*of_models, *keys) if word.startswith(begun)]


if __name__ == "__main__":
    main()
