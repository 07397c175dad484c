"""The machine: its description, its peak rates of computation and copying, and the memory that functions need.

The rates of matrix products and copies give lower bounds of run times.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import torch

CLEAR_REFS = Path("/proc/self/clear_refs")


def environment() -> dict[str, Any]:
    """Describe the environment of a measurement: time, commit, versions and machine."""
    return {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "machine": platform.machine(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def _processor() -> str:
    """Return the name of the processor, as far as the system provides it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines() if cpuinfo.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor())


def commit() -> str:
    """Return the commit of the running code as ``git describe`` names it, with ``-dirty`` if files differ from it.

    The answer is ``unknown`` if the code is not tracked in a repository, or git is not installed.
    """
    here = Path(__file__).resolve()
    try:
        tracked = subprocess.run(["git", "ls-files", "--error-unmatch", here.name], cwd=here.parent, capture_output=True, check=False)
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty"],
            cwd=here.parent,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            check=False,
        )
    except OSError:
        return "unknown"
    return (not tracked.returncode and described.stdout.strip()) or "unknown"


def keep_freed_memory() -> None:
    """Let this process reuse the memory of large freed arrays instead of returning it to the system.

    The system clears memory each time it hands it out. With arrays of edges larger than 32 MB, the clearing can take half of a rollout on a CPU. The function
    calls glibc's ``mallopt`` and does nothing with other C libraries. Free memory above 2 GiB at the end of the heap is still returned.
    """
    mmap_threshold, trim_threshold = -3, -1  # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD in malloc.h
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        for option in (mmap_threshold, trim_threshold):
            libc.mallopt(option, 2**31 - 1)


def has_cpp_compiler() -> bool:
    """Whether a C++ compiler is installed. ``torch.compile`` needs one on a CPU."""
    return any(shutil.which(name) for name in ("c++", "g++", "clang++", "cl"))


def work_clock(on_gpu: bool) -> Callable[[], float]:
    """Return a clock [s] for finished work: processor time of all threads on a CPU, which depends less on other processes, and wall time on a GPU."""

    def wall_time() -> float:
        torch.cuda.synchronize()
        return time.perf_counter()

    return wall_time if on_gpu else time.process_time


def synchronized(function: Callable[[], Any], device: str) -> Callable[[], Any]:
    """Return a function that also waits until the GPU has finished the work; unchanged for other devices."""
    if not device.startswith("cuda"):
        return function

    def call() -> Any:
        result = function()
        torch.cuda.synchronize()
        return result

    return call


def best_time(function: Callable[[], Any], device: str, num_rounds: int = 10, clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the time of the fastest of several calls [s], after one call that does not count."""
    call = synchronized(function, device)
    call()
    times = []
    for _ in range(num_rounds):
        start = clock()
        call()
        times.append(clock() - start)
    return min(times)


def gemm_rate(rows: int, channels: int, device: str, clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the rate of the product of a matrix [rows, channels] with a square one [FLOP/s].

    Compare it with times of the same ``clock``: processor time counts every thread. The rate is also measured with at most 1024 rows, whose product fits into
    the cache. The higher rate is returned.
    """
    square = torch.randn(channels, channels, device=device)
    rates = []
    for height in (rows, min(rows, 1024)):
        matrix, result = torch.randn(2, height, channels, device=device)
        seconds = best_time(partial(torch.mm, matrix, square, out=result), device, 50, clock)
        rates.append(2 * height * channels**2 / seconds)
    return max(rates)


def reduces_precision(device: str) -> bool:
    """Whether single-precision products lose precision on this device when PyTorch allows it. Not every processor or GPU has units for that."""
    left, right = torch.linspace(0.1, 0.9, 2 * 256**2, device=device).view(2, 256, 256)
    before = torch.get_float32_matmul_precision()
    products = []
    try:
        for precision in ("highest", "medium"):
            torch.set_float32_matmul_precision(precision)
            products.append(left @ right)
    finally:
        torch.set_float32_matmul_precision(before)
    return bool((products[1] - products[0]).norm() > 1e-5 * products[0].norm())  # rounding to bfloat16 changes 1e-3


def copy_rate(device: str, num_bytes: int = 2**28) -> float:
    """Return the rate at which this machine copies an array that is too large for caches, as bytes read plus bytes written per second."""
    source = torch.zeros(num_bytes // 4, device=device)
    target = torch.empty_like(source)
    return 2 * num_bytes / best_time(lambda: target.copy_(source), device, 5)


def peak_on_gpu(function: Callable[[], Any]) -> int:
    """Return the largest GPU memory during the second of two calls, less the memory in use before it [bytes]."""
    function()
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    synchronized(function, "cuda")()
    return torch.cuda.max_memory_allocated() - before


def peaks_in_turn(functions: Mapping[str, Callable[[], Any]]) -> dict[str, int]:
    """Call functions one after the other, and return the memory that each needs in addition to the memory in use before the first [bytes], by name.

    Call it in a process that did nothing like this before, because memory that an earlier call has freed is not counted. The peak of a function is at least
    that of those before it. On a GPU use ``peak_on_gpu`` instead.
    """
    before, found = _resident(), dict[str, int]()
    for name, function in functions.items():
        function()
        found[name] = peak_resident() - before
    return found


def peak_memory(function: Callable[..., Callable[[], Any]], *arguments: Any) -> int:
    """Return the largest memory during a call, less the memory in use before it [bytes], measured in a separate process.

    On a GPU use ``peak_on_gpu`` instead.

    Args:
        function: picklable function that returns the function to measure.
        arguments: passed to ``function``.

    Raises:
        MemoryError: the separate process ended without an answer.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_peak_memory, args=(sender, function, arguments))
    process.start()
    sender.close()
    try:
        return int(receiver.recv())
    except EOFError:
        raise MemoryError(f"the process that was to measure the memory of {function.__name__} ended without an answer") from None
    finally:
        process.join()


def _peak_memory(sender: Any, function: Callable[..., Callable[[], Any]], arguments: tuple[Any, ...]) -> None:
    torch.set_num_threads(1)
    call = function(*arguments)
    before = _resident()
    call()
    sender.send(peak_resident() - before)


def _resident() -> int:
    """Return the memory of this process in use [bytes], after resetting the recorded peak on Linux.

    Other systems cannot reset the peak. There the result is the peak so far, and a function that needs less memory than that peak seems to need none.
    """
    if not CLEAR_REFS.exists():
        return peak_resident()
    CLEAR_REFS.write_text("5", encoding="utf-8")
    return resident_bytes()


def peak_resident() -> int:
    """Return the peak memory of this process so far [bytes]."""
    if CLEAR_REFS.exists():
        return _status("VmHWM")
    if hasattr(usage := psutil.Process().memory_info(), "peak_wset"):  # Windows
        return int(usage.peak_wset)
    import resource  # does not exist on Windows

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(f"{key}:")).split()[1])


def resident_bytes() -> int:
    """Return the memory of this process in use now [bytes]."""
    return int(psutil.Process().memory_info().rss)
