"""Benchmark of speed: times of a forward pass and of a training step of all models on the same graph.

The models are GPE with every interaction, with and without fused passes, and the baselines. The time of a whole rollout step of the shipped models is reported
over the time of its matrix products, see ``step_ratio``; so is that of a training step, see ``training_step_ratio``.

Two lower bounds (floors) are reported for GPE in full precision. The first is the time of its matrix products at the machine's measured rate. The second is
the time for moving every edge state in and out of memory once per layer.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode
from torch_geometric.data import HeteroData

from gpe_pl.benchmarks.step_ratio import step_records, step_table
from gpe_pl.benchmarks.trained import Case as Trained
from gpe_pl.benchmarks.training_step_ratio import training_records, training_table
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.files.markdown import table_row
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.lattice import lattice_graph, lattice_scene
from gpe_pl.graphs.neighbors import radius_pairs
from gpe_pl.models.base import Model
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.fused import unfused
from gpe_pl.nn.momentum_conv import EdgeState, Implementation, Interaction
from gpe_pl.schema import FeatureSpec
from gpe_pl.system.machine import copy_rate, gemm_rate, has_cpp_compiler, peak_memory, peak_on_gpu, reduces_precision, synchronized
from gpe_pl.system.timing import apart, paired_ratio, paired_times
from gpe_pl.training.run import TrainingSettings

log = logging.getLogger(__name__)

INTERACTIONS: tuple[Interaction, ...] = ("directed", "negated", "odd", "odd_even")
REFERENCE = "directed, plain"
"""Case with which others are compared: the usual message passing, which multiplies concatenated features of each directed edge."""
TRAINS = True
"""Whether the suite also takes the settings of a training on each data set."""
SAND = "sand"
MEDIUM = ", medium"
STEP_ROUNDS = 5
"""Rollouts of a shipped model per round of measurements."""


@dataclass(frozen=True)
class Settings:
    """Size of the problem, and how it is timed. Edges are counted as undirected.

    Attributes:
        num_nodes, num_edges: size of the graph.
        num_message_passing_steps, hidden_channels: size of the models.
        num_rounds: number of rounds of measurements; the median counts.
        num_threads: threads of PyTorch.
        accelerator: device of the models.
        compile: also time ``torch.compile``, if a compiler is installed.
        seed: seed of the weights.
        cases: data sets of shipped models, by the name of the model; a rollout step of each is timed.
    """

    num_nodes: Annotated[int, Field(ge=10)] = 2500
    num_edges: Annotated[int, Field(ge=10)] = 24000
    num_message_passing_steps: Annotated[int, Field(ge=1, le=64)] = 12
    hidden_channels: Annotated[int, Field(ge=1, le=4096)] = 128
    num_rounds: Annotated[int, Field(ge=1)] = 7
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1
    accelerator: Literal["cpu", "gpu"] = "cpu"
    compile: bool = True
    seed: Annotated[int, Field(ge=0)] = 0
    cases: dict[str, Trained] = field(default_factory=dict)

    @property
    def device(self) -> str:
        return "cuda" if self.accelerator == "gpu" else "cpu"


@dataclass(frozen=True)
class Case:
    """A model to time.

    Attributes:
        model: class of the model.
        interaction, implementation, edge_state: settings of ``GPE``.
        is_fused: use the fused passes for CPUs.
        compiled: apply ``torch.compile``.
        precision: precision of float32 products, as in ``torch.set_float32_matmul_precision``.
    """

    model: Literal["GPE", "GNS", "DPINet", "ContinuousConvNet"] = "GPE"
    interaction: Interaction = "negated"
    implementation: Implementation = "factored"
    edge_state: EdgeState = "latent"
    is_fused: bool = True
    compiled: bool = False
    precision: Literal["highest", "medium"] = "highest"

    def runs(self, function: Callable[[], Any]) -> Callable[[], Any]:
        """Return a function that makes the same call with this case's precision of float32 products (``medium`` allows bfloat16 inside).

        Fused passes are off unless ``is_fused``.
        """

        def call() -> Any:
            before = torch.get_float32_matmul_precision()
            torch.set_float32_matmul_precision(self.precision)
            try:
                with nullcontext() if self.is_fused else unfused():
                    return function()
            finally:
                torch.set_float32_matmul_precision(before)

        return call

    @property
    def saves_against(self) -> str | None:
        """Name of the case that differs only by computing both directions of an edge, or None if there is no such case."""
        if self.model != "GPE" or self.edge_state != "latent" or self.compiled or self.precision != "highest":
            return None
        if self.implementation == "plain":
            return "directed, plain"
        return None if self.is_fused else "directed, factored"

    def build(self, spec: FeatureSpec, num_steps: int, hidden: int, seed: int = 0) -> Model:
        """Build the model with ``num_steps`` layers of ``hidden`` channels. Cases with the same parameters get the same weights from one seed."""
        torch.manual_seed(seed)
        if self.model == "GNS":
            return GNS(spec, num_steps, hidden)
        if self.model == "DPINet":
            return DPINet(spec, num_steps, hidden)
        if self.model == "ContinuousConvNet":
            return ContinuousConvNet(spec, num_steps, hidden)
        return GPE(
            spec,
            interaction=self.interaction,
            edge_state=self.edge_state,
            num_message_passing_steps=num_steps,
            hidden_channels=hidden,
            implementation=self.implementation,
        )


def cases(compiled: bool, reduced: bool) -> dict[str, Case]:
    """Return the timed cases by name, the reference first. ``compiled`` adds cases with ``torch.compile``, ``reduced`` cases with less precise products."""
    found = {f"{i}, plain": Case(interaction=i, implementation="plain") for i in INTERACTIONS}
    found |= {f"{i}, factored": Case(interaction=i, is_fused=False) for i in INTERACTIONS}
    found |= {i: Case(interaction=i) for i in ("negated", "odd")}
    if compiled:
        found |= {f"{i}, compiled": Case(interaction=i, compiled=True) for i in ("negated", "odd")}
    if reduced:
        found |= {f"directed, plain{MEDIUM}": Case(interaction="directed", implementation="plain", precision="medium")}
        found |= {f"{i}{MEDIUM}": Case(interaction=i, precision="medium") for i in ("negated", "odd")}
    found |= {f"{i}, geometry": Case(interaction=i, edge_state="geometry") for i in ("negated", "odd")}
    return found | {name: Case(model=name) for name in ("GNS", "DPINet", "ContinuousConvNet")}


def flop(model: Model, graph: HeteroData) -> int:
    """Count the floating-point operations of the matrix products in a forward pass.

    The model is moved to the meta device, where no fused passes hide products. It loses its weights there.
    """
    with torch.inference_mode(), FlopCounterMode(display=False) as counter:
        model.to("meta")(graph.clone().to("meta"))
    return int(counter.get_total_flops())


def edge_bytes(case: Case, spec: FeatureSpec, graph: HeteroData, settings: Settings) -> int:
    """Return a lower bound of the bytes of edge states that a forward pass of GPE moves.

    Latent states are written by the encoder and by every layer except the last, and read by every layer. Edge features (``geometry``) are only read.
    """
    edges = sum(graph[r].edge_index.shape[1] * (2 if case.interaction == "directed" else 1) for r in spec.relations)
    if case.edge_state == "geometry":
        channels = next(spec.odd_channels[r] + spec.even_channels[r] for r in spec.relations)
        return 4 * edges * channels * settings.num_message_passing_steps
    return 4 * edges * settings.hidden_channels * 2 * settings.num_message_passing_steps


def forward_pass(case: Case, settings: Settings) -> Callable[[], Any]:
    """Return a forward pass in inference, with graph and model already built."""
    model, graph = _built(case, settings)
    return synchronized(case.runs(torch.inference_mode()(lambda: model(graph))), settings.device)


def training_pass(case: Case, settings: Settings) -> Callable[[], Any]:
    """Return a training step, with graph and model already built."""
    return synchronized(case.runs(training_step(*_built(case, settings))), settings.device)


def _built(case: Case, settings: Settings) -> tuple[Model, HeteroData]:
    torch.set_num_threads(settings.num_threads)
    builder, graph = lattice_graph(settings.num_nodes, settings.num_edges, GraphConfig())
    model = case.build(builder.spec, settings.num_message_passing_steps, settings.hidden_channels, settings.seed).to(settings.device)
    return _compiled(model, settings.device) if case.compiled else model, graph.to(settings.device)


def training_step(model: Model, graph: HeteroData) -> Callable[[], Any]:
    """Return a step of forward and backward pass, clipping, and Adam with learning rate zero."""
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0, fused=True)

    def step() -> Tensor:
        optimizer.zero_grad()
        loss = model(graph).acceleration[SAND].square().mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        return loss

    return step


def _compiled(model: Model, device: str) -> Model:
    mode = "reduce-overhead" if device == "cuda" else None  # uses CUDA graphs
    model.compute = torch.compile(model.compute, dynamic=device != "cuda", mode=mode)
    return model


def run(settings: Settings, specs: dict[str, DatasetSpec], trainings: dict[str, TrainingSettings]) -> tuple[list[dict[str, Any]], str]:
    """Return records of times [s], paired ratios, floors and memory, and a Markdown table."""
    torch.set_num_threads(settings.num_threads)
    device = settings.device
    builder, graph = lattice_graph(settings.num_nodes, settings.num_edges, GraphConfig())
    spec, size = builder.spec, (settings.num_message_passing_steps, settings.hidden_channels, settings.seed)
    num_edges = sum(graph[r].edge_index.shape[1] for r in spec.relations)
    compiles = settings.compile and (device != "cpu" or has_cpp_compiler())
    if settings.compile and not compiles:
        log.warning("suite.compile: found no C++ compiler, so the cases with torch.compile are left out")
    todo = cases(compiles, reduces_precision(device))
    forward = _beside_the_reference(forward_pass, todo, settings, settings.num_rounds, "forward passes")
    training = _beside_the_reference(training_pass, todo, settings, max(1, settings.num_rounds // 2), "training steps")

    gemm, copy = gemm_rate(num_edges, settings.hidden_channels, device), copy_rate(device)
    records: list[dict[str, Any]] = [
        {"metric": "gemm_rate", "case": device, "value": gemm, "unit": "FLOP/s"},
        {"metric": "copy_rate", "case": device, "value": copy, "unit": "B/s"},
    ]
    for name, case in todo.items():
        values: dict[str, tuple[float, str]] = {
            "forward_time": (forward[name].seconds, "s"),
            "training_time": (training[name].seconds, "s"),
            "forward_speedup": (1 / forward[name].ratio, "1"),
            "forward_speedup_vs_gns": (forward["GNS"].ratio / forward[name].ratio, "1"),
            "training_speedup": (1 / training[name].ratio, "1"),
        }
        if case.precision != "highest":
            found, expected = (forward_pass(todo[n], settings)().acceleration[SAND] for n in (name, name.removesuffix(MEDIUM)))
            values["forward_difference"] = (float((found - expected).norm() / expected.norm()), "1")
        elif case.model == "GPE":
            if case.saves_against is not None:
                values["forward_time_saved"] = (1 - forward[name].ratio / forward[case.saves_against].ratio, "1")
            values["flop"] = (flop(case.build(spec, *size), graph), "FLOP")
            values["flop_floor"] = (values["flop"][0] / gemm, "s")
            values["byte_floor"] = (edge_bytes(case, spec, graph, settings) / copy, "s")
            values["floor_ratio"] = (values["forward_time"][0] / values["flop_floor"][0], "1")
        if device != "cpu":
            values["peak_memory"] = (peak_on_gpu(forward_pass(case, settings)), "B")
            values["training_peak_memory"] = (peak_on_gpu(training_pass(case, settings)), "B")
        elif not case.compiled and case.precision == "highest":
            values["peak_memory"] = (peak_memory(forward_pass, case, settings), "B")
            values["training_peak_memory"] = (peak_memory(training_pass, case, settings), "B")
        records += [{"metric": metric, "case": name, "value": value, "unit": unit} for metric, (value, unit) in values.items()]
    records += _graph_records(settings)
    steps = step_records(specs, STEP_ROUNDS * settings.num_rounds)
    training_steps = training_records(specs, trainings, settings.num_rounds)
    tables = [table(settings, num_edges, records), *([step_table(steps), training_table(training_steps)] if steps else [])]
    return records + steps + training_steps, "\n\n".join(tables)


@dataclass(frozen=True)
class Timing:
    """Time of a case: the median in ``seconds``, and the median ``ratio`` to the time of the reference in the same round."""

    seconds: float
    ratio: float


def _beside_the_reference(
    make: Callable[[Case, Settings], Callable[[], Any]], todo: dict[str, Case], settings: Settings, num_rounds: int, what: str
) -> dict[str, Timing]:
    """Time every case in turns with the reference, each in a separate process. Only these two exist at a time, because a training step may keep gigabytes."""
    found = {}
    with apart({REFERENCE: partial(make, todo[REFERENCE], settings)}) as reference:
        for name, case in todo.items():
            with apart({} if name == REFERENCE else {name: partial(make, case, settings)}) as other:
                times = paired_times(reference | other, num_rounds, num_warmups=3)
            found[name] = Timing(float(np.median(times[name])), paired_ratio(times, name, REFERENCE))
            log.info("%s, %s: %.3f s", what, name, found[name].seconds)
    return found


def _graph_records(settings: Settings) -> list[dict[str, Any]]:
    """Return records of the neighbour search, and of the whole graph with its features, without the model."""
    builder, state = lattice_scene(settings.num_nodes, settings.num_edges, GraphConfig())
    pos = state.pos.numpy()
    functions: dict[str, Callable[[], Any]] = {
        "neighbor_time": lambda: radius_pairs(pos, builder.scales.radius),
        "graph_time": lambda: builder(state),
    }
    times = paired_times(functions, settings.num_rounds)
    return [{"metric": name, "case": "cpu", "value": float(np.median(t)), "unit": "s"} for name, t in times.items()]


def _cells(values: dict[str, float]) -> list[str]:
    def text(metric: str, scale: float, form: str) -> str:
        return format(values[metric] * scale, form) if metric in values else "–"

    return [
        text("forward_time", 1e3, ".0f"),
        text("forward_speedup", 1.0, ".1f"),
        text("forward_speedup_vs_gns", 1.0, ".1f"),
        text("forward_time_saved", 100.0, ".0f"),
        text("flop_floor", 1e3, ".0f"),
        text("byte_floor", 1e3, ".0f"),
        text("floor_ratio", 1.0, ".2f"),
        text("training_time", 1e3, ".0f"),
        text("training_speedup", 1.0, ".1f"),
        text("peak_memory", 1e-6, ".0f"),
        text("training_peak_memory", 1e-6, ".0f"),
    ]


def table(settings: Settings, num_edges: int, records: list[dict[str, Any]]) -> str:
    """Return the Markdown table of the records of a run."""
    header = [
        *("model", "forward [ms]", "faster", "than GNS", "saved [%]", "product floor [ms]", "byte floor [ms]", "over floor"),
        *("training [ms]", "faster", "memory [MB]", "training [MB]"),
    ]
    of_case: dict[str, dict[str, float]] = {}
    for record in records:
        of_case.setdefault(record["case"], {})[record["metric"]] = record["value"]
    machine = {r["metric"]: r["value"] for r in records if r["metric"] in ("gemm_rate", "copy_rate", "neighbor_time", "graph_time")}
    lines = [table_row([name, *_cells(values)]) for name, values in of_case.items() if "forward_time" in values]
    reduced = {name.removesuffix(MEDIUM): v["forward_difference"] for name, v in of_case.items() if "forward_difference" in v}
    medium = (
        "which changes the "
        + ", ".join(f"{name} output by {100 * change:.1g} %" for name, change in reduced.items())
        + " (untrained weights, relative L2)."
        if reduced
        else "but not on this machine, so the case is not timed."
    )
    return "\n".join(
        [
            f"{settings.num_nodes:,} nodes, {num_edges:,} undirected edges, {settings.num_message_passing_steps} × {settings.hidden_channels}, "
            f"{settings.accelerator}, {settings.num_threads} thread(s); measured: {machine['gemm_rate'] / 1e9:.0f} GFLOP/s in products, "
            f"{machine['copy_rate'] / 1e9:.1f} GB/s in copies. Neighbour search {1e3 * machine['neighbor_time']:.1f} ms, "
            f"whole graph with features {1e3 * machine['graph_time']:.1f} ms.",
            "",
            table_row(header),
            "|" + "---|" * len(header),
            *lines,
            "",
            f"Times: medians, each model in a separate process that keeps its memory. Faster: median of ratios to `{REFERENCE}`, timed in turns, which "
            "multiplies the concatenated features of every directed edge. Factored: node features are multiplied before the gather to edges, with PyTorch's "
            "operations; names without an addition use the fused passes. Saved: time saved against `directed` of the same implementation; the paper reports "
            "37 % for `negated`. Product floor: the case's matrix products at the measured rate. Byte floor: its edge states in and out once per layer at the "
            "copy rate. Geometry: raw edge features instead of latent edge states. Memory: beyond weights and graph. Medium: products may use bfloat16 inside "
            "(`trainer.matmul_precision=medium`), " + medium,
        ]
    )
