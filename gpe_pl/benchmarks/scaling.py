"""Benchmark of scaling: time and memory of a rollout step against the number of nodes, in 2D and 3D, with the fitted exponent."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from gpe_pl.files.markdown import table_row
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.lattice import lattice_scene
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.momentum_conv import EdgeState
from gpe_pl.rollout.skips import Skips
from gpe_pl.system.machine import peak_memory, peak_on_gpu, synchronized
from gpe_pl.system.timing import paired_ratio, paired_times

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

EDGES_PER_NODE = {2: 9.6, 3: 15.0}
"""Typical number of undirected edges per node in the graphs of data sets, by dimension."""
NUM_PAIRS = 3
"""Number of timed pairs of forward passes with and without ordered nodes; each pass takes seconds."""


@dataclass(frozen=True)
class Settings:
    """Settings of scenes and model.

    Attributes:
        num_nodes: sizes of the scenes.
        dimensions: dimensions of the scenes.
        fitted: range of sizes over which the exponent is fitted. Times per edge and layer are compared between its smallest and largest size.
        num_message_passing_steps, hidden_channels, edge_state: settings of the model.
        budget: time [s] for repetitions of the graph, and as much for those of the forward pass, at one size. The fastest counts.
        num_threads: threads of PyTorch.
        accelerator: device of the model; graphs are built on the CPU.
        seed: seed of the weights.
    """

    num_nodes: Annotated[list[Annotated[int, Field(ge=10)]], Field(min_length=1)] = field(default_factory=lambda: [1000, 10_000, 100_000])
    dimensions: Annotated[list[Literal[2, 3]], Field(min_length=1)] = field(default_factory=lambda: [2, 3])
    fitted: tuple[int, int] = (10_000, 200_000)
    num_message_passing_steps: Annotated[int, Field(ge=1, le=64)] = 12
    hidden_channels: Annotated[int, Field(ge=1, le=4096)] = 128
    edge_state: EdgeState = "latent"
    budget: Annotated[float, Field(ge=0)] = 5.0
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1
    accelerator: Literal["cpu", "gpu"] = "cpu"
    seed: Annotated[int, Field(ge=0)] = 0

    def __post_init__(self) -> None:
        for name, values in (("num_nodes", self.num_nodes), ("dimensions", self.dimensions)):
            if len(set(values)) < len(values):
                raise ValueError(f"{name}: {list(values)} contains the same value twice")
        if not 0 < self.fitted[0] < self.fitted[1]:
            raise ValueError(f"fitted: {list(self.fitted)} must go from a smaller to a larger number of nodes")

    @property
    def device(self) -> str:
        return "cuda" if self.accelerator == "gpu" else "cpu"


@dataclass(frozen=True)
class Step:
    """A rollout step in two parts: a function that builds the ``graph``, and the model's ``forward`` pass on it. ``num_edges`` is its number of edges."""

    graph: Callable[[], Any]
    forward: Callable[[], Any]
    num_edges: int


def prepare(settings: Settings, num_nodes: int, dim: int, skips: Skips | None = None) -> Step:
    """Return a step on a lattice with ``num_nodes`` nodes in ``dim`` dimensions; ``skips`` are the levels of skipping of the model."""
    torch.manual_seed(settings.seed)
    builder, state = lattice_scene(num_nodes, int(EDGES_PER_NODE[dim] * num_nodes), GraphConfig(), dim)
    graph = builder(state).to(settings.device)
    model = GPE(
        builder.spec,
        edge_state=settings.edge_state,
        num_message_passing_steps=settings.num_message_passing_steps,
        hidden_channels=settings.hidden_channels,
    ).to(settings.device)
    model.skips = skips or Skips()
    model.eval()
    num_edges = sum(graph[r].edge_index.shape[1] for r in builder.spec.relations)
    forward = synchronized(torch.inference_mode()(lambda: model(graph)), settings.device)
    return Step(lambda: builder(state), forward, num_edges)


def whole_step(settings: Settings, num_nodes: int, dim: int) -> Callable[[], Any]:
    """Return a step as one function, for measuring its memory."""
    step = prepare(settings, num_nodes, dim)
    return lambda: (step.graph(), step.forward())


def run(settings: Settings) -> tuple[list[dict[str, Any]], str]:
    """Return records of times [s], memory [B] and exponents per dimension, and a Markdown table."""
    torch.set_num_threads(settings.num_threads)
    records: list[dict[str, Any]] = []
    lines = []
    for dim in settings.dimensions:
        rows = []
        for num_nodes in settings.num_nodes:
            step = prepare(settings, num_nodes, dim)
            graph_time, forward_time = (_fastest(part, settings.budget) for part in (step.graph, step.forward))
            num_edges = step.num_edges
            del step
            memory = (
                peak_memory(whole_step, settings, num_nodes, dim)
                if settings.device == "cpu"
                else peak_on_gpu(whole_step(settings, num_nodes, dim))
            )
            per_edge = forward_time / num_edges / settings.num_message_passing_steps
            log.info("%dD, %d nodes: %.3f s per step", dim, num_nodes, graph_time + forward_time)
            rows.append((num_nodes, graph_time + forward_time, per_edge))
            values = {
                "step_time": (graph_time + forward_time, "s"),
                "graph_time": (graph_time, "s"),
                "forward_time": (forward_time, "s"),
                "edge_layer_time": (per_edge, "s"),
                "peak_memory": (memory, "B"),
                "num_edges": (num_edges, "1"),
            }
            records += [
                {"metric": m, "case": f"{dim}d, {num_nodes}", "dimension": dim, "num_nodes": num_nodes, "value": v, "unit": unit}
                for m, (v, unit) in values.items()
            ]
            lines.append(
                table_row(
                    [f"{dim}D", f"{num_nodes:,}", f"{num_edges:,}", f"{1e3 * graph_time:.1f}", f"{1e3 * forward_time:.1f}", f"{1e9 * per_edge:.0f}",
                     f"{memory / 1e6:.0f}"]
                )
            )  # fmt: skip
        records += _fit(rows, settings.fitted, dim)
        largest = max(settings.num_nodes)
        if largest >= (Skips().sorted_from or math.inf):
            about = {"case": f"{dim}d", "dimension": dim, "num_nodes": largest, "unit": "1"}
            records.append({"metric": "sorted_time_ratio", "value": _sorted_time_ratio(settings, largest, dim), **about})
    return records, _table(settings, lines, records)


def _sorted_time_ratio(settings: Settings, num_nodes: int, dim: int) -> float:
    """Return the time of a forward pass with nodes in the order of edges over that with nodes in the original order; median over pairs."""
    alternatives = {
        name: prepare(settings, num_nodes, dim, skips).forward
        for name, skips in (("sorted", Skips()), ("as they come", Skips(sorted_from=None)))
    }
    return paired_ratio(paired_times(alternatives, NUM_PAIRS), "sorted", "as they come")


def _fastest(function: Callable[[], Any], budget: float) -> float:
    """Return the time of the fastest call [s]. One call is made before the timing starts, and at least one is timed."""
    function()
    times: list[float] = []
    while not times or sum(times) < budget:
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def _fit(rows: list[tuple[int, float, float]], fitted: tuple[int, int], dim: int) -> list[dict[str, Any]]:
    """Return the exponent p of time ∝ Nᵖ, by least squares of the logarithms, and the ratio of times per edge and layer at the ends of the range.

    Return nothing if fewer than two sizes lie in the range.
    """
    inside = sorted(row for row in rows if fitted[0] <= row[0] <= fitted[1])
    if len(inside) < 2:
        return []
    size, seconds = np.log([row[0] for row in inside]), np.log([row[1] for row in inside])
    exponent = float(np.polyfit(size, seconds, 1)[0])
    ratio = inside[-1][2] / inside[0][2]
    about = {"case": f"{dim}d", "dimension": dim, "unit": "1"}
    return [{"metric": "scaling_exponent", "value": exponent, **about}, {"metric": "edge_layer_time_ratio", "value": ratio, **about}]


def _table(settings: Settings, lines: list[str], records: list[dict[str, Any]]) -> str:
    header = ["", "nodes", "edges", "graph [ms]", "forward [ms]", "per edge and layer [ns]", "peak memory [MB]"]
    fits = []
    for record in records:
        if record["metric"] == "scaling_exponent":
            ratio = next(r["value"] for r in records if r["metric"] == "edge_layer_time_ratio" and r["case"] == record["case"])
            fits.append(
                f"{record['case'].upper()}: time of a step ∝ N^{record['value']:.3f}, time per edge and layer at the larger end × {ratio:.2f}"
            )
    between = f"Between {settings.fitted[0]:,} and {settings.fitted[1]:,} nodes: " + "; ".join(fits) + "." if fits else ""
    return "\n".join(
        [
            f"GPE {settings.num_message_passing_steps} × {settings.hidden_channels}, {settings.edge_state} edge states, {settings.accelerator}, "
            f"{settings.num_threads} thread(s). {between}",
            "",
            table_row(header),
            "|" + "---|" * len(header),
            *lines,
            "",
            " ".join(
                [
                    "Graph: neighbour search and features. Peak memory: of a step in inference, beyond weights and the scene.",
                    *_ordered(records),
                ]
            ),
        ]
    )


def _ordered(records: list[dict[str, Any]]) -> Iterator[str]:
    for r in records:
        if r["metric"] == "sorted_time_ratio":
            yield f"{r['case'].upper()}, {r['num_nodes']:,} nodes: in the order of edges, a forward pass takes {100 * r['value']:.0f} % of the time."


def figures(records: list[dict[str, Any]]) -> dict[str, Figure]:
    """Draw time and memory against the number of nodes."""
    from gpe_pl.viz.figures import scaling_figure

    def curves(metric: str) -> dict[str, dict[int, float]]:
        found: dict[str, dict[int, float]] = {}
        for r in records:
            if r["metric"] == metric:
                found.setdefault(f"{r['dimension']}D", {})[r["num_nodes"]] = float(r["value"])
        return found

    return {"scaling": scaling_figure(curves("step_time"), "time of a step [s]", curves("peak_memory"), "peak memory [B]")}
