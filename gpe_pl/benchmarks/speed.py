"""Benchmark of speed: times of a forward pass and of a training step of all models on the same graph.

The models are GPE with every interaction, with and without fused passes, and the baselines. The time of a whole rollout step of the shipped models is reported
over the time of its matrix products, see ``step_ratio``; so is that of a training step, see ``training_step_ratio``.

Two lower bounds (floors) are reported for GPE in full precision. The first is the time of its matrix products at the machine's measured rate. The second is
the time for moving every edge state in and out of memory once per layer.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode
from torch_geometric.data import HeteroData

from gpe_pl.benchmarks.finished_parts import PARTS, FinishedParts
from gpe_pl.benchmarks.step_ratio import step_records, step_table
from gpe_pl.benchmarks.trained import Case as Trained
from gpe_pl.benchmarks.trained import fingerprint_of
from gpe_pl.benchmarks.training_step_ratio import training_records, training_table
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.files.markdown import table_row
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.lattice import lattice_graph, lattice_scene
from gpe_pl.graphs.neighbors import radius_pairs
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.base import Model
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.fused import unfused
from gpe_pl.nn.momentum_conv import EdgeState, Implementation, Interaction
from gpe_pl.schema import FeatureSpec
from gpe_pl.system.machine import copy_rate, gemm_rate, has_cpp_compiler, peak_on_gpu, peaks_in_turn, reduces_precision, synchronized
from gpe_pl.system.timing import apart, paired_ratio, paired_times
from gpe_pl.training.run import TrainingSettings

log = logging.getLogger(__name__)

INTERACTIONS: tuple[Interaction, ...] = ("directed", "negated", "odd", "odd_even")
REFERENCE = "directed, plain"
"""Case with which others are compared: the usual message passing, which multiplies concatenated features of each directed edge."""
REFERENCE_CASE: dict[str, Any] = {"interaction": "directed", "implementation": "plain"}
AT_ONCE = 2
"""Number of cases that are timed in turns with the reference. Training steps of the three take 7 GB together."""
Wanted = Literal["forward", "training", "peaks"]
RESUMES = True
"""``run`` takes a folder and continues where an earlier run was stopped."""
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
    found = {REFERENCE: Case(**REFERENCE_CASE)} | {f"{i}, plain": Case(interaction=i, implementation="plain") for i in INTERACTIONS}
    found |= {f"{i}, factored": Case(interaction=i, is_fused=False) for i in INTERACTIONS}
    found |= {i: Case(interaction=i) for i in ("negated", "odd")}
    if compiled:  # of one case, because compilation takes a minute
        found |= {"negated, compiled": Case(compiled=True)}
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


class Passes:
    """Forward passes in evaluation mode, and training steps, of a case. Graph and model are made once.

    Args:
        case: the case.
        settings: size of the graph and of the model.
    """

    def __init__(self, case: Case, settings: Settings) -> None:
        torch.set_num_threads(settings.num_threads)
        builder, graph = lattice_graph(settings.num_nodes, settings.num_edges, GraphConfig())
        model = case.build(builder.spec, settings.num_message_passing_steps, settings.hidden_channels, settings.seed).to(settings.device)
        model = _compiled(model, settings.device) if case.compiled else model
        graph = graph.to(settings.device)
        self.model, self.device = model, settings.device
        self.forward = synchronized(case.runs(torch.inference_mode()(lambda: model.eval()(graph))), self.device)
        self.train = synchronized(case.runs(training_step(model, graph)), self.device)

    def __call__(self, wanted: Wanted) -> dict[str, int] | None:
        """Run a pass; or return the memory [B] that each needs beyond weights and graph, in a process that has run none."""
        if wanted == "peaks":
            passes = {"peak_memory": self.forward, "training_peak_memory": self.train}
            return peaks_in_turn(passes) if self.device == "cpu" else {name: peak_on_gpu(function) for name, function in passes.items()}
        (self.forward if wanted == "forward" else self.train)()
        return None


def training_step(model: Model, graph: HeteroData) -> Callable[[], Any]:
    """Return a step of forward and backward pass, clipping, and Adam with learning rate zero."""
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0, fused=True)

    def step() -> Tensor:
        model.train()
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


def run(
    settings: Settings, specs: dict[str, DatasetSpec], trainings: dict[str, TrainingSettings], folder: Path
) -> tuple[list[dict[str, Any]], str]:
    """Return records of times [s], paired ratios, floors and memory, and a Markdown table.

    Finished parts are stored in ``folder``: groups of cases, and each shipped model.
    """
    torch.set_num_threads(settings.num_threads)
    device, parts = settings.device, FinishedParts(folder / PARTS)
    compiles = settings.compile and (device != "cpu" or has_cpp_compiler())
    if settings.compile and not compiles:
        log.warning("suite.compile: found no C++ compiler, so the cases with torch.compile are left out")
    todo = cases(compiles, reduces_precision(device))
    names, measured = [name for name in todo if name != REFERENCE], list[dict[str, Any]]()
    for first in range(0, len(names), AT_ONCE):
        group = names[first : first + AT_ONCE]
        identity = {"settings": asdict(settings), "cases": {name: asdict(todo[name]) for name in group}}
        measured += _measured(parts, identity, ", ".join(group), partial(_beside_the_reference, {n: todo[n] for n in group}, settings))
    of_case: dict[str, dict[str, float]] = {}
    for record in measured:
        of_case.setdefault(record["case"], {}).setdefault(record["metric"], record["value"])  # the reference is in every group

    builder, graph = lattice_graph(settings.num_nodes, settings.num_edges, GraphConfig())
    num_edges = sum(graph[r].edge_index.shape[1] for r in builder.spec.relations)
    records = _case_records(settings, {name: todo[name] for name in todo if name in of_case}, of_case, builder.spec, graph)
    records += _graph_records(settings)
    steps, training_steps = list[dict[str, Any]](), list[dict[str, Any]]()
    for name, spec in specs.items():
        about: dict[str, Any] = {
            "num_rounds": settings.num_rounds,
            "num_threads": settings.num_threads,
            "model": fingerprint_of(LearnedSimulator.from_checkpoint(name)),
            "data": spec.as_dict(),
        }
        steps += _measured(parts, about | {"part": "step"}, name, partial(step_records, {name: spec}, STEP_ROUNDS * settings.num_rounds))
        training = partial(training_records, {name: spec}, {name: trainings[name]}, settings.num_rounds)
        training_steps += _measured(parts, about | {"part": "training", "training": asdict(trainings[name])}, name, training)
    parts.clear()
    tables = [table(settings, num_edges, records), *([step_table(steps), training_table(training_steps)] if steps else [])]
    return records + steps + training_steps, "\n\n".join(tables)


def _measured(
    parts: FinishedParts, identity: dict[str, Any], what: str, measure: Callable[[], list[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """Return the records of a part: those of a stopped suite, or new ones."""
    if (stored := parts.get(identity)) is not None:
        return stored
    started = time.perf_counter()
    records = measure()
    log.info("measured %s in %.0f s", what, time.perf_counter() - started)
    parts.put(identity, records)
    return records


def _beside_the_reference(group: dict[str, Case], settings: Settings) -> list[dict[str, Any]]:
    """Return times [s], ratios to the reference and memory [B] of some cases, timed in turns with the reference, each in a separate process.

    Only these processes exist at a time, because a training step may keep gigabytes.
    """
    together = {REFERENCE: Case(**REFERENCE_CASE), **group}
    values: dict[tuple[str, str], float] = {}
    with apart({name: partial(Passes, case, settings) for name, case in together.items()}, [__name__]) as passes:
        for name, case in together.items():
            if settings.device != "cpu" or not (case.compiled or case.precision != "highest"):
                values |= {(name, metric): float(value) for metric, value in passes[name]("peaks").items()}
        for kind, num_rounds in (("forward", settings.num_rounds), ("training", max(1, settings.num_rounds // 2))):
            times = paired_times({name: partial(call, kind) for name, call in passes.items()}, num_rounds, num_warmups=1)
            for name in together:
                values[name, f"{kind}_time"] = float(np.median(times[name]))
                values[name, f"{kind}_ratio"] = paired_ratio(times, name, REFERENCE)
    return [{"case": name, "metric": metric, "value": value} for (name, metric), value in values.items()]


def _case_records(
    settings: Settings, todo: dict[str, Case], of_case: dict[str, dict[str, float]], spec: FeatureSpec, graph: HeteroData
) -> list[dict[str, Any]]:
    """Return the records of all cases from their times and memory, with the rates of this machine."""
    size = settings.num_message_passing_steps, settings.hidden_channels, settings.seed
    gemm = gemm_rate(sum(graph[r].edge_index.shape[1] for r in spec.relations), settings.hidden_channels, settings.device)
    copy = copy_rate(settings.device)
    records: list[dict[str, Any]] = [
        {"metric": "gemm_rate", "case": settings.device, "value": gemm, "unit": "FLOP/s"},
        {"metric": "copy_rate", "case": settings.device, "value": copy, "unit": "B/s"},
    ]
    for name, case in todo.items():
        own = of_case[name]
        values: dict[str, tuple[float, str]] = {
            "forward_time": (own["forward_time"], "s"),
            "training_time": (own["training_time"], "s"),
            "forward_speedup": (1 / own["forward_ratio"], "1"),
            "forward_speedup_vs_gns": (of_case["GNS"]["forward_ratio"] / own["forward_ratio"], "1"),
            "training_speedup": (1 / own["training_ratio"], "1"),
        }
        if case.precision != "highest":
            found, expected = (_prediction(todo[n], settings) for n in (name, name.removesuffix(MEDIUM)))
            values["forward_difference"] = (float((found - expected).norm() / expected.norm()), "1")
        elif case.model == "GPE":
            if case.saves_against is not None:
                values["forward_time_saved"] = (1 - own["forward_ratio"] / of_case[case.saves_against]["forward_ratio"], "1")
            values["flop"] = (flop(case.build(spec, *size), graph), "FLOP")
            values["flop_floor"] = (values["flop"][0] / gemm, "s")
            values["byte_floor"] = (edge_bytes(case, spec, graph, settings) / copy, "s")
            values["floor_ratio"] = (own["forward_time"] / values["flop_floor"][0], "1")
        values |= {metric: (own[metric], "B") for metric in ("peak_memory", "training_peak_memory") if metric in own}
        records += [{"metric": metric, "case": name, "value": value, "unit": unit} for metric, (value, unit) in values.items()]
    return records


def _prediction(case: Case, settings: Settings) -> Tensor:
    return cast(Tensor, Passes(case, settings).forward().acceleration[SAND])


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
