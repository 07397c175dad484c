"""Processes of a data-parallel run on one machine, without new interpreters."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import socket
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch.distributed as dist

TIMEOUT = 300.0


def on_ranks(folder: Path, function: Callable[[int], Any], num_ranks: int = 2) -> list[Any]:
    """Return the results of ``function(rank)`` in each process of a group; fail if one of them raises or hangs."""

    def work(rank: int) -> Any:
        dist.init_process_group("gloo", init_method=f"file://{folder / 'rendezvous'}", rank=rank, world_size=num_ranks)
        return function(rank)

    return _forked(folder, work, num_ranks)


def as_launched(folder: Path, function: Callable[[int], Any], num_ranks: int = 2) -> list[Any]:
    """Run as ``on_ranks`` with the group in the environment, where Lightning finds it for processes that ``torchrun`` or Slurm has started."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]

    def work(rank: int) -> Any:
        group = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "NODE_RANK": 0, "LOCAL_RANK": rank, "WORLD_SIZE": num_ranks}
        os.environ.update({k: str(v) for k, v in group.items()})
        return function(rank)

    return _forked(folder, work, num_ranks)


def _forked(folder: Path, work: Callable[[int], Any], num_ranks: int) -> list[Any]:
    """Fork processes, because the imports of a new interpreter take longer than most tests."""
    folder.mkdir(parents=True, exist_ok=True)

    def run(rank: int) -> None:
        value, code = None, 0
        try:
            value = work(rank)
        except SystemExit:
            pass
        except BaseException:
            value, code = traceback.format_exc(), 1
        (folder / f"{rank}.pickle").write_bytes(pickle.dumps(value))
        os._exit(code)  # neither pytest nor Lightning has anything to do at the end of a copy

    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=run, args=(rank,)) for rank in range(num_ranks)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(TIMEOUT)
    hanging = [rank for rank, process in enumerate(processes) if process.exitcode is None]
    for process in processes:
        process.kill()
    assert not hanging, f"ranks {hanging} hang"
    values = [pickle.loads((folder / f"{rank}.pickle").read_bytes()) for rank in range(num_ranks)]
    failed = [value for process, value in zip(processes, values, strict=True) if process.exitcode]
    assert not failed, "\n".join(failed)
    return values
