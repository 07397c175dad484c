"""Benchmark of skipping: the cost of a step when irrelevant parts are added to a scene.

Such parts are distant walls, falling particles, materials without particles, and piles at rest.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from gpe_pl.files.markdown import table_row
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.lattice import lattice_scene
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.momentum_conv import EdgeState
from gpe_pl.rollout.loop import Simulator, steps
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import param_names
from gpe_pl.system.machine import synchronized
from gpe_pl.system.timing import paired_ratio, paired_times
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

MATERIALS = ("sand", "snow", "fluid")
FAR = 5.0
"""Offset [m] of the added parts along each axis. They are out of reach of the scene, whose side is 1 m."""


@dataclass(frozen=True)
class Settings:
    """Settings of the scene and of the irrelevant parts.

    Attributes:
        num_nodes, num_edges: size of the relevant scene.
        num_message_passing_steps, hidden_channels: size of the models.
        edge_states: settings ``edge_state`` of the compared models.
        num_boundary: number of boundary nodes out of reach.
        num_falling: number of particles in free fall without neighbours.
        num_settled: number of copies of the scene at rest, far from each other.
        repeats: numbers of frames for which one prediction is repeated.
        num_rounds: number of rounds of measurements; the median counts.
        num_threads: threads of PyTorch.
        accelerator: device of the models.
        seed: seed of the weights.
    """

    num_nodes: Annotated[int, Field(ge=10)] = 2500
    num_edges: Annotated[int, Field(ge=10)] = 24000
    num_message_passing_steps: Annotated[int, Field(ge=1, le=64)] = 12
    hidden_channels: Annotated[int, Field(ge=1, le=4096)] = 128
    edge_states: Annotated[list[EdgeState], Field(min_length=1)] = field(default_factory=lambda: ["latent", "geometry"])
    num_boundary: list[Annotated[int, Field(ge=1)]] = field(default_factory=lambda: [5000, 50000])
    num_falling: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1)] = field(default_factory=lambda: [2500, 10000])
    num_settled: list[Annotated[int, Field(ge=1)]] = field(default_factory=lambda: [1, 4])
    repeats: list[Annotated[int, Field(gt=1)]] = field(default_factory=lambda: [2, 4])
    num_rounds: Annotated[int, Field(ge=1)] = 11
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1
    accelerator: Literal["cpu", "gpu"] = "cpu"
    seed: Annotated[int, Field(ge=0)] = 0

    @property
    def device(self) -> str:
        return "cuda" if self.accelerator == "gpu" else "cpu"


@dataclass(frozen=True)
class Growth:
    """A scene with an added part.

    Attributes:
        metric: name of the metric: the fraction by which a step takes longer.
        amount: amount that was added, in words.
        state: state of the grown scene.
        builder: builder of its graphs.
        on, off: levels of skipping with and without the one that skips the added part.
    """

    metric: str
    amount: str
    state: State
    builder: GraphBuilder
    on: Skips
    off: Skips


def scene_of(settings: Settings) -> tuple[GraphBuilder, State]:
    """Return the relevant scene: a moving lattice without gravity, so that parts beside it can rest."""
    builder, scene = lattice_scene(settings.num_nodes, settings.num_edges, GraphConfig())
    return builder, replace(scene, gravity=torch.zeros_like(scene.gravity)).to_torch(settings.device)


def growths(settings: Settings, builder: GraphBuilder, scene: State) -> list[Growth]:
    """Return the scene with each kind and amount of irrelevant parts."""
    found = []
    for n in settings.num_boundary:
        found.append(
            Growth(
                "distant_boundary_overhead", f"{n:,} boundary nodes", _with_walls(scene, n), builder, Skips(), Skips(static_boundary=False)
            )
        )
    for n in settings.num_falling:
        found.append(
            Growth("falling_overhead", f"{n:,} falling nodes", _with_falling(scene, n), builder, Skips(), Skips(isolated_nodes=False))
        )
    others, state = _with_absent_materials(builder, scene)
    found.append(Growth("absent_materials_overhead", "2 absent materials", state, others, Skips(), Skips(absent_types=False)))
    for n in settings.num_settled:
        found.append(Growth("settled_overhead", f"{n} settled piles", _with_settled(scene, n), builder, Skips(sleep_after=1), Skips()))
    return found


def simulator(settings: Settings, edge_state: EdgeState, builder: GraphBuilder, skips: Skips) -> LearnedSimulator:
    """Return a simulator with random weights. Its accelerations are so small that nodes at rest stay at rest."""
    torch.manual_seed(settings.seed)
    model = GPE(
        builder.spec,
        edge_state=edge_state,
        num_message_passing_steps=settings.num_message_passing_steps,
        hidden_channels=settings.hidden_channels,
    )
    made = LearnedSimulator(model, copy.copy(builder)).to(settings.device).eval()
    made.acceleration_std.fill_(1e-9)
    made.skips = skips
    return made


def absent_material_calls(settings: Settings, skips: Skips) -> int:
    """Count the calls of modules for materials that the model has and the scene lacks, in one step."""
    builder, state = _with_absent_materials(*scene_of(settings))
    made = simulator(settings, settings.edge_states[0], builder, skips)
    absent, count = MATERIALS[1:], 0

    def see(*_: Any) -> None:
        nonlocal count
        count += 1

    for path, module in made.named_modules():
        if any(material in part.split("__") for material in absent for part in path.split(".")) and not any(module.children()):
            module.register_forward_pre_hook(see)
    made.step(state)
    return count


def message_passing_calls(settings: Settings, builder: GraphBuilder, scene: State, skips: Skips) -> int:
    """Count the calls of message-passing layers and node updates that get more than one row, in a step with falling nodes only."""
    made = simulator(settings, settings.edge_states[0], builder, skips)
    count = 0

    def see(_: Any, inputs: tuple[Any, ...]) -> None:
        nonlocal count
        count += inputs[0].shape[0] > 1

    model: Any = made.model
    for layers in (*model.convs, *model.updates):
        for layer in layers.values():
            layer.register_forward_pre_hook(see)
    made.step(_falling(scene, settings.num_falling[0]))
    return count


def run(settings: Settings) -> tuple[list[dict[str, Any]], str]:
    """Measure the cost of each growing scene with its level of skipping on and off.

    Returns:
        Records and a Markdown table. Records hold step times [s], overheads relative to the scene without the added part, the time with repeated predictions
        over that with a prediction for each frame, and the numbers of calls of layers with a level on and off.
    """
    torch.set_num_threads(settings.num_threads)
    builder, scene = scene_of(settings)
    records: list[dict[str, Any]] = []
    lines = []
    for edge_state in settings.edge_states:
        for growth in growths(settings, builder, scene):
            small = simulator(settings, edge_state, builder, Skips())
            alternatives = {"small": synchronized(_step(small, scene), settings.device)}
            for level in ("on", "off"):
                runner = simulator(settings, edge_state, growth.builder, getattr(growth, level))
                alternatives[level] = synchronized(_step(approximate(runner), growth.state), settings.device)
            times = paired_times(alternatives, settings.num_rounds, what=f"{edge_state}, {growth.amount}")
            cells = [edge_state, growth.amount]
            for level in ("on", "off"):
                case = f"{growth.amount}, {level}, {edge_state}"
                overhead = paired_ratio(times, level, "small") - 1
                records.append({"metric": "step_time", "case": case, "value": float(np.median(times[level])), "unit": "s"})
                records.append({"metric": growth.metric, "case": case, "value": overhead, "unit": "1"})
                cells += [f"{1e3 * np.median(times[level]):.1f}", f"{100 * overhead:+.1f} %"]
            cells.insert(2, f"{1e3 * np.median(times['small']):.1f}")
            lines.append(table_row(cells))
        for repeats in settings.repeats:
            ratio = _repeat_time_ratio(settings, edge_state, builder, scene, repeats)
            records.append({"metric": "repeat_time_ratio", "case": f"{repeats} frames, {edge_state}", "value": ratio, "unit": "1"})
    for level, skips in (("on", Skips()), ("off", Skips(isolated_nodes=False))):
        calls = message_passing_calls(settings, builder, scene, skips)
        records.append({"metric": "falling_message_passing_calls", "case": level, "value": calls, "unit": "1"})
    for level, skips in (("on", Skips()), ("off", Skips(absent_types=False))):
        calls = absent_material_calls(settings, skips)
        records.append({"metric": "absent_material_calls", "case": level, "value": calls, "unit": "1"})
    graph = builder(scene)
    num_edges = sum(graph[r].edge_index.shape[1] for r in builder.spec.relations)
    return records, _table(settings, num_edges, lines, records)


def _repeat_time_ratio(settings: Settings, edge_state: EdgeState, builder: GraphBuilder, scene: State, repeats: int) -> float:
    """Return the time of ``repeats`` frames with one repeated prediction over that with a prediction for each frame."""

    def frames(skips: Skips) -> Callable[[], State]:
        runner = approximate(simulator(settings, edge_state, builder, skips))

        def call() -> State:
            *_, last = steps(runner, scene, repeats)
            return last

        return synchronized(call, settings.device)

    times = paired_times({"repeated": frames(Skips(repeat_frames=repeats)), "exact": frames(Skips())}, settings.num_rounds)
    return paired_ratio(times, "repeated", "exact")


def _table(settings: Settings, num_edges: int, lines: list[str], records: list[dict[str, Any]]) -> str:
    calls = {(r["metric"], r["case"]): r["value"] for r in records if r["metric"].endswith("_calls")}
    fractions = [f"{r['case']} {100 * r['value']:.0f} %" for r in records if r["metric"] == "repeat_time_ratio"]
    repeated = (
        f" Repeated predictions, another approximate level, take these fractions of the time: {', '.join(fractions)}." if fractions else ""
    )
    header = ["edge state", "added", "without it [ms]", "level on [ms]", "longer by", "level off [ms]", "longer by"]
    return "\n".join(
        [
            f"A step of {settings.num_nodes} nodes with {num_edges} edges, GPE {settings.num_message_passing_steps} × {settings.hidden_channels}, "
            f"{settings.num_threads} thread(s), and a step of the same scene with irrelevant parts; medians, and medians of paired ratios.",
            "",
            table_row(header),
            "|" + "---|" * len(header),
            *lines,
            "",
            f"A step of {settings.num_falling[0]} falling nodes alone calls {calls['falling_message_passing_calls', 'on']} layers with more than one row, or "
            f"{calls['falling_message_passing_calls', 'off']} with the level off. A step without snow and liquid calls "
            f"{calls['absent_material_calls', 'on']} of their modules, or {calls['absent_material_calls', 'off']} with the level off. Settled piles are at "
            "perfect rest here, without gravity and with tiny accelerations. Their level is approximate; evaluation measures its error. All other levels "
            f"are exact.{repeated}",
        ]
    )


def _step(runner: Simulator, state: State) -> Callable[[], State]:
    """Return a step from the given positions and velocities, after two steps in which the level of skipping takes effect."""
    for _ in range(2):
        state = replace(runner.step(state), pos=state.pos, vel=state.vel, velocity_history=state.velocity_history)
    return lambda: runner.step(state)


def _further(scene: State, pos: torch.Tensor, vel: torch.Tensor) -> State:
    """Return nodes of sand with constant velocities, without the nodes of the scene."""
    assert scene.velocity_history is not None
    some = scene.take(torch.zeros(len(pos), dtype=torch.int64))
    return replace(some, pos=pos, vel=vel, velocity_history=vel[:, None].repeat(1, scene.velocity_history.shape[1], 1))


def _with_walls(scene: State, count: int) -> State:
    rng = np.random.default_rng(0)
    pos = torch.from_numpy(rng.uniform(FAR, FAR + 1, (count, scene.dim))).to(scene.pos.device)
    normal = torch.zeros_like(pos)
    normal[:, 1] = 1.0
    return replace(scene, boundary=Boundary(pos, torch.zeros_like(pos), normal, pos.new_ones(count), pos.new_zeros(count)))


def _falling(scene: State, count: int) -> State:
    """Return a scene of nodes without neighbours, 1 m apart. They fall freely; without gravity, they stay."""
    side = int(np.ceil(count ** (1 / scene.dim)))
    lattice = np.stack(np.unravel_index(np.arange(count), (side,) * scene.dim), axis=-1)
    pos = FAR + torch.from_numpy(lattice.astype(float)).to(scene.pos.device)
    return _further(scene, pos, torch.zeros_like(pos))


def _with_falling(scene: State, count: int) -> State:
    return State.joined([scene, _falling(scene, count)])


def _with_absent_materials(builder: GraphBuilder, scene: State) -> tuple[GraphBuilder, State]:
    names = param_names(MATERIALS)
    params = torch.full((scene.num_nodes, len(names)), torch.nan, dtype=torch.float64, device=scene.pos.device)
    params[:, :1] = scene.material_params
    metadata = replace(builder.metadata, materials=MATERIALS, param_names=names)
    return GraphBuilder(builder.config, metadata), replace(scene, material_params=params)


def _with_settled(scene: State, count: int) -> State:
    pos = torch.cat([scene.pos + (k + 1) * FAR for k in range(count)])
    return State.joined([scene, _further(scene, pos, torch.zeros_like(pos))])
