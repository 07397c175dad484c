"""Ctrl-C before a command has started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gpe_pl.system import early_interrupts


@pytest.mark.skipif(os.name == "nt", reason="sends a signal")
@pytest.mark.parametrize("command", ["fit", "convert"])
def test_a_command_that_is_interrupted_in_its_imports_ends_with_one_line(command: str, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    line = [sys.executable, "-X", "importtime", "-m", f"gpe_pl.{command}"]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env=environment, cwd=tmp_path) as process:
        assert process.stderr is not None
        while "omegaconf" not in process.stderr.readline():  # Hydra's imports follow
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        lines = [text for text in process.stderr.read().splitlines() if not text.startswith("import time:")]
    assert (lines, process.returncode) == (["interrupted"], early_interrupts.STATUS)


def test_programs_that_import_the_package_keep_their_own_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGINT)
    for argv, orig in ((["-m"], ["python", "-m", "other"]), (["program.py"], ["python", "program.py", "gpe_pl.fit"])):
        monkeypatch.setattr(sys, "argv", argv)
        monkeypatch.setattr(sys, "orig_argv", orig)
        early_interrupts.begin()
        assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_in_a_destructor_is_not_lost() -> None:
    """Python ignores what destructors raise, and prints a traceback."""
    program = """
import signal, time
from gpe_pl.system import early_interrupts
early_interrupts.end()

class Dying:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)
        time.sleep(0)

try:
    Dying()
    for _ in range(1000):
        time.sleep(0.01)
except KeyboardInterrupt:
    print("interrupted")
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, encoding="utf-8", check=True)
    assert (ended.stdout, ended.stderr) == ("interrupted\n", "")
