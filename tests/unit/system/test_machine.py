"""Rates of the machine are plausible, and the measured memory of a function is its own."""

from __future__ import annotations

import platform
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gpe_pl.system import machine
from gpe_pl.system.machine import commit, copy_rate, environment, gemm_rate, peak_memory, peaks_in_turn
from gpe_pl.system.timing import apart


def filling(num_bytes: int) -> Callable[[], int]:
    return lambda: int(np.ones(num_bytes, dtype=np.uint8)[-1])


def failing() -> Callable[[], int]:
    raise RuntimeError("no")


def test_numbers_know_the_commit_of_their_code() -> None:
    assert re.fullmatch(r"[0-9a-f]{7,40}(-dirty)?|unknown", commit())
    assert environment()["commit"] == commit()


def test_a_copy_in_a_repository_of_something_else_has_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subprocess.run(["git", "init", "-q", tmp_path], check=True)
    subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "x", "--allow-empty"], cwd=tmp_path, check=True)
    copy = tmp_path / "machine.py"
    copy.touch()
    monkeypatch.setattr(machine, "__file__", str(copy))
    assert commit() == "unknown"
    monkeypatch.setenv("PATH", str(tmp_path))  # without git
    assert commit() == "unknown"


def test_a_clock_of_work_on_a_gpu_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    order = list[str]()
    monkeypatch.setattr("torch.cuda.synchronize", lambda: order.append("finished"))
    monkeypatch.setattr("time.perf_counter", lambda: order.append("read") or 1.0)  # type: ignore[func-returns-value]
    monkeypatch.setattr("time.process_time", lambda: 7.0)
    assert machine.work_clock(on_gpu=True)() == 1.0 and order == ["finished", "read"]
    assert machine.work_clock(on_gpu=False)() == 7.0 and len(order) == 2


def test_rates_are_positive() -> None:
    assert gemm_rate(64, 8, "cpu") > 0 and copy_rate("cpu", 2**16) > 0


@pytest.mark.slow
def test_memory_is_what_a_function_takes() -> None:
    small, large = peak_memory(filling, 10**6), peak_memory(filling, 3 * 10**8)
    assert 0.9 * 3e8 < large < 1.5 * 3e8 and small < 1e8


def peaks() -> Callable[[], dict[str, int]]:
    return lambda: peaks_in_turn({"small": filling(10**6), "large": filling(3 * 10**8)})


@pytest.mark.slow
def test_memory_of_functions_in_one_process_is_what_each_takes() -> None:
    with apart({"peaks": peaks}) as calls:
        found = calls["peaks"]()
    assert 0.9 * 3e8 < found["large"] < 1.5 * 3e8 and found["small"] < 1e8


@pytest.mark.slow
def test_a_function_that_fails_says_so() -> None:
    with pytest.raises(MemoryError, match="failing ended without an answer"):
        peak_memory(failing)


def test_memory_is_known_where_there_is_no_proc_and_no_resource(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """On Windows, for example, psutil knows the peak."""
    resident = machine.resident_bytes()
    assert 0.5 * resident < machine.peak_resident() < 100 * resident
    monkeypatch.setattr(machine, "CLEAR_REFS", tmp_path / "none")
    assert 0.5 * resident < machine.peak_resident() < 100 * resident  # from `resource`, in the system's own unit
    monkeypatch.setitem(sys.modules, "resource", None)
    monkeypatch.setattr(machine.psutil.Process, "memory_info", lambda _: SimpleNamespace(rss=1, peak_wset=7))
    assert machine.peak_resident() == 7 and machine.resident_bytes() == 1


PAGES_OF_NEW_ARRAYS = """
import resource, sys
import numpy as np
from gpe_pl.system.machine import keep_freed_memory
if sys.argv[1] == "kept":
    keep_freed_memory()
def fill(count):
    for _ in range(count):
        np.ones(2**26, dtype=np.uint8)
fill(2)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
fill(20)
print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) * resource.getpagesize() / 2**26)
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="its allocator is not glibc's")
def test_memory_of_freed_arrays_is_not_cleared_again() -> None:
    """Counts the new memory of twenty arrays, one after the other, in units of one array. Huge pages reduce the number of pages."""
    cleared = {
        how: float(subprocess.run([sys.executable, "-c", PAGES_OF_NEW_ARRAYS, how], capture_output=True, text=True, check=True).stdout)
        for how in ("kept", "given back")
    }
    assert cleared["kept"] < 0.01 < 0.03 < cleared["given back"]
