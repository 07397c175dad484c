"""Benchmark of data-parallel training: nodes per second with one process, and with several that share the same batches.

A step does what training does: build the graphs, forward and backward pass, sum the gradients over processes, clip, Adam. The scene is sand on a jittered
lattice.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import torch.distributed as dist
from pydantic import Field

from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.lattice import lattice_scene
from gpe_pl.models.gpe import GPE
from gpe_pl.system import ranks
from gpe_pl.training.parallel import sum_gradients

SAND = "sand"
NUM_WARM_UPS = 3


class ParallelError(GpeError, ValueError):
    """Raised when there are too many processes for this machine or for these batches."""


@dataclass(frozen=True)
class Settings:
    """Size of the problem, and number of processes.

    Attributes:
        num_processes: numbers of processes to compare; speed-ups are relative to the first.
        num_graphs: graphs per step, over all processes.
        num_nodes, num_edges: nodes and edges per graph.
        num_message_passing_steps, hidden_channels: size of the model.
        num_steps: number of timed steps; the median counts.
        num_threads: threads of PyTorch in each process.
        accelerator: device of all processes.
    """

    num_processes: list[Annotated[int, Field(ge=1)]] = field(default_factory=lambda: [1, 2])
    num_graphs: Annotated[int, Field(ge=1)] = 4
    num_nodes: Annotated[int, Field(ge=10)] = 2500
    num_edges: Annotated[int, Field(ge=10)] = 24000
    num_message_passing_steps: Annotated[int, Field(ge=1, le=64)] = 12
    hidden_channels: Annotated[int, Field(ge=1, le=4096)] = 128
    num_steps: Annotated[int, Field(ge=1)] = 20
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1
    accelerator: Literal["cpu", "gpu"] = "cpu"


def run(settings: Settings) -> tuple[list[dict[str, Any]], str]:
    """Return records of step times [s], throughput [nodes/s] and speed-ups, and a Markdown table.

    Raises:
        ParallelError: there are fewer graphs or GPUs than processes.
    """
    most = max(settings.num_processes)
    if most > settings.num_graphs:
        raise ParallelError(
            f"suite.num_graphs={settings.num_graphs}: too few for {most} processes, each of which takes at least one; raise it"
        )
    if settings.accelerator == "gpu" and most > torch.cuda.device_count():
        raise ParallelError(f"suite.num_processes={settings.num_processes}: this machine has {torch.cuda.device_count()} GPUs; lower it")
    records, lines = [], []
    for number in settings.num_processes:
        step, exchange = np.median(np.array(step_times(settings, number)), axis=0).tolist()
        throughput = settings.num_graphs * settings.num_nodes / step
        values = {"step_time": (step, "s"), "exchange_time": (exchange, "s"), "throughput": (throughput, "nodes/s")}
        records += [{"metric": m, "case": str(number), "value": v, "unit": unit} for m, (v, unit) in values.items()]
        speedup = throughput / next(r["value"] for r in records if r["metric"] == "throughput")
        records.append({"metric": "speedup", "case": str(number), "value": speedup, "unit": "1"})
        efficiency = speedup * settings.num_processes[0] / number
        lines.append(table_row([str(number), f"{throughput:,.0f}", f"{speedup:.2f}", f"{100 * efficiency:.0f}", *_ms(step, exchange)]))
    header = ["processes", "nodes per second", "speed-up", "efficiency [%]", "step [ms]", "exchange [ms]"]
    about = (
        f"{settings.num_graphs} graphs of {settings.num_nodes:,} nodes and {settings.num_edges:,} undirected edges per step, shared by the processes; "
        f"{settings.num_message_passing_steps} × {settings.hidden_channels}, {settings.accelerator}, {settings.num_threads} thread(s) per process. Medians of "
        f"{settings.num_steps} steps. Exchange: waiting for the others included."
    )
    return records, "\n".join([about, "", table_row(header), "|" + "---|" * len(header), *lines])


def _ms(*times: float) -> list[str]:
    return [f"{1e3 * t:.1f}" for t in times]


def step_times(settings: Settings, num_processes: int) -> list[tuple[float, float]]:
    """Return the time of each step and of its exchange of gradients [s], as measured by the first process of a new group."""
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(num_processes, multiprocessing.get_context("spawn")) as pool:
        meeting = (Path(folder) / "rendezvous").as_uri()
        futures = [pool.submit(_times_on_rank, settings, rank, num_processes, meeting) for rank in range(num_processes)]
        first, *_ = (future.result() for future in futures)
        return first


def _times_on_rank(settings: Settings, rank: int, num_processes: int, meeting: str) -> list[tuple[float, float]]:
    torch.set_num_threads(settings.num_threads)
    on_gpu = settings.accelerator == "gpu"
    device = torch.device("cuda", rank) if on_gpu else torch.device("cpu")
    if on_gpu:
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if on_gpu else "gloo", meeting, timedelta(minutes=5), num_processes, rank)
    scenes = [
        lattice_scene(settings.num_nodes, settings.num_edges, GraphConfig(), seed=seed)
        for seed in range(rank, settings.num_graphs, num_processes)
    ]
    torch.manual_seed(0)
    model = GPE(
        scenes[0][0].spec, num_message_passing_steps=settings.num_message_passing_steps, hidden_channels=settings.hidden_channels
    ).to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0, fused=True)

    def now() -> float:
        if on_gpu:
            torch.cuda.synchronize()
        return time.perf_counter()

    times = []
    for _ in range(NUM_WARM_UPS + settings.num_steps):
        dist.barrier()
        start = now()
        optimizer.zero_grad()
        graphs = batched([builder(state) for builder, state in scenes]).to(device)
        squares = model(graphs).acceleration[SAND].square()
        (squares.sum() / ranks.summed(torch.tensor(float(squares.numel()), device=device))).backward()
        middle = now()
        sum_gradients(model.parameters())
        exchanged = now()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        times.append((now() - start, exchanged - middle))
    dist.destroy_process_group()
    return times[NUM_WARM_UPS:]
