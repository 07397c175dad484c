"""Processes that share work: Ctrl-C reaches all of them, and is handled once."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gpe_pl.system.workers import WorkerError, pool, results

SCRIPT = """
import time
from gpe_pl.system.workers import pool, results

if __name__ == "__main__":
    try:
        with pool(2) as workers:
            print("ready", flush=True)
            for _ in results(workers, time.sleep, [(120,)] * 4):
                pass
    except KeyboardInterrupt:
        print("interrupted")
"""


def test_results_of_one_process_and_of_several() -> None:
    for number in (1, 2):
        with pool(number) as workers:
            assert sorted(results(workers, pow, [(2, k) for k in range(5)])) == [1, 2, 4, 8, 16]


def test_a_process_that_dies() -> None:
    with pytest.raises(WorkerError, match="a worker process died"), pool(2) as workers:
        list(results(workers, os._exit, [(1,)]))


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs groups of processes")
@pytest.mark.parametrize("delay", [0.0, 0.2, 1.5])
def test_an_interrupt_ends_all_of_them_at_once(tmp_path: Path, delay: float) -> None:
    """Before, while and after the others start."""
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "script.py")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    time.sleep(delay)
    os.killpg(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert (output, errors, process.returncode) == ("interrupted\n", "", 0)
    until = time.monotonic() + 30
    while _runs(process.pid):
        assert time.monotonic() < until, "processes stay behind"
        time.sleep(0.05)


def _runs(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
