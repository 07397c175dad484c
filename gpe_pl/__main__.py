"""Console script ``gpe_pl COMMAND …``. It does the same as ``python -m gpe_pl.COMMAND …``."""

from __future__ import annotations

import runpy
import sys

from gpe_pl.system import early_interrupts

USAGE = f"usage: gpe_pl {{{','.join(early_interrupts.COMMANDS)}}} [KEY=VALUE …]"


def main() -> None:
    """Run the command that the first argument names."""
    command, *arguments = sys.argv[1:] or [""]
    if command in ("-h", "--help"):
        print(f"{USAGE}\n`gpe_pl COMMAND --help` shows the settings of a command.")
    elif command in early_interrupts.COMMANDS:
        sys.argv[1:] = arguments
        runpy.run_module(f"gpe_pl.{command}", run_name="__main__", alter_sys=True)
    else:
        sys.exit(f"error: {f'unknown command {command!a}' if command else 'no command'}; {USAGE}")


if __name__ == "__main__":
    main()
