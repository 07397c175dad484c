"""The page's steps in JavaScript equal those of the simulator. Skipped without Node."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.export.play_model import PageError, model_for_page
from gpe_pl.export.play_page import PARTS, check_film
from gpe_pl.export.play_scene import state_for_page
from gpe_pl.geometry.shapes import Bowl, Box, Polygon, Shape, Sphere, Wall
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import rollout, steps
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="node is not installed")

DRIVER = """
import fs from "fs";
const given = JSON.parse(fs.readFileSync(0, "utf8"));
const { Simulator } = await import(`${given.parts}/step.mjs`);
const { boundaryOf } = await import(`${given.parts}/shapes.mjs`);
const bytes = Buffer.from(given.weights, "base64");
const numbers = new Float32Array(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
const simulator = new Simulator(given.model, numbers, given.plain);
const boundary = boundaryOf(given.states[0].shapes, given.model.spacing);
const pos = [], corrected = [];
for (const start of given.states) {
  const state = { count: start.count };
  for (const name of ["pos", "vel", "history", "mass", "params"]) state[name] = Float64Array.from(start[name]);
  for (let k = 0; k < given.num; k++) {
    corrected.push(simulator.step(state, boundary, start.shapes).corrected);
    pos.push(Array.from(state.pos));
  }
}
const { compiled } = simulator.kernels;
console.log(JSON.stringify({ pos, corrected, compiled, boundary: Array.from(boundary.pos), normal: Array.from(boundary.normal) }));
"""

FLOOR = Wall((0.0, 1.0), 0.0, (0.0, 0.0), (1.0, 1.0), 0.5)
SIDE = Wall((1.0, 0.0), 0.0, (0.0, 0.0), (1.0, 1.0), 0.0)
OBSTACLES = {
    "solids": (
        Sphere((0.3, 0.1), 0.06, 0.4),
        Box((0.02, 0.22), (0.08, 0.36), 1e6),
        Polygon(((0.34, 0.02), (0.55, 0.02), (0.4, 0.12)), 0.3),
    ),
    "bowl": (Bowl((0.35, 0.3), 0.28, 0.3),),
}


def block(corner: tuple[float, float], side: int, spacing: float, seed: int) -> np.ndarray:
    lattice = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    return np.asarray(corner) + spacing * (lattice + np.random.default_rng(seed).uniform(-0.2, 0.2, lattice.shape))


def scene(simulator: LearnedSimulator, shapes: tuple[Shape, ...]) -> State:
    """Return a block that is about to hit an obstacle, one that flies freely, and a single particle that enters a wall."""
    metadata, low = simulator.builder.metadata, dict(simulator.trained_ranges())[simulator.builder.spec.materials[0]][0]
    blocks = [block((0.26, 0.17), 7, metadata.spacing, 0), block((0.5, 0.5), 5, metadata.spacing, 1), np.array([[0.3, 0.3]])]
    velocities = [(0.2, -1.5), (1.0, 0.5), (-6.0, 0.0)]
    pos = np.concatenate(blocks)
    vel = np.concatenate([np.tile(v, (len(b), 1)) for v, b in zip(velocities, blocks, strict=True)])
    vel[1::3] *= 0.97  # blocks deform, too
    state = State(
        pos=pos,
        vel=vel,
        node_type=np.full(len(pos), node_code(simulator.builder.spec.materials[0]), np.uint8),
        mass=np.full(len(pos), 0.39),
        material_params=np.full((len(pos), 1), 1.2 * float(low[0])),
        boundary=Boundary.sample(shapes, metadata.spacing, 2),
        gravity=np.array(metadata.gravity),
    )
    return simulator.standing(state, metadata)


def in_javascript(simulator: LearnedSimulator, states: list[State], num: int, plain: bool = False) -> dict[str, Any]:
    """Return the positions after each of ``num`` steps from each state [step, node, 2], the numbers of corrected nodes, and the boundary nodes."""
    model, numbers = model_for_page(simulator)
    given = {
        "parts": PARTS.as_uri(),
        "model": model,
        "weights": base64.b64encode(numbers.tobytes()).decode(),
        "states": [state_for_page(state, [0], simulator.builder.metadata.spacing) for state in states],
        "num": num,
        "plain": plain,
    }
    command = [str(NODE), "--input-type=module", "-e", DRIVER]
    result = subprocess.run(command, input=json.dumps(given), capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    answer = json.loads(result.stdout)
    return answer | {"pos": np.array(answer["pos"]).reshape(len(answer["pos"]), states[0].num_nodes, 2)}


def in_python(simulator: LearnedSimulator, state: State, num: int) -> list[State]:
    return [*steps(Contained(simulator, simulator.builder.metadata.frame_dt), state, num)]


@pytest.fixture(scope="module", params=["sand", "snow"])
def simulator(request: pytest.FixtureRequest) -> LearnedSimulator:
    return LearnedSimulator.from_checkpoint(request.param)


@pytest.mark.slow
@pytest.mark.parametrize("kind", OBSTACLES)
def test_every_step_of_a_rollout_equals_that_of_the_simulator(simulator: LearnedSimulator, kind: str) -> None:
    state = scene(simulator, (FLOOR, SIDE, *OBSTACLES[kind]))
    later = in_python(simulator, state, 40)
    found = in_javascript(simulator, [state, *later[:-1]], 1)
    assert found["compiled"]  # WebAssembly with vectors
    corrected = [s.num_corrected for s in later]
    assert found["corrected"] == corrected
    assert sum(corrected) > 0
    assert np.abs(found["pos"] - np.stack([s.pos.numpy() for s in later])).max() < 1e-7


@pytest.mark.slow
def test_static_friction_holds_what_lies_and_not_what_leans(simulator: LearnedSimulator) -> None:
    simulator = simulator.on(simulator.builder.metadata)
    simulator.static_friction = 0.99
    spacing, state = simulator.builder.metadata.spacing, scene(simulator, (FLOOR, SIDE))
    pos = np.concatenate([block((0.3, 0.5 * spacing), 7, spacing, 0), block((0.5 * spacing, 0.4), 5, spacing, 1), [[0.7, 0.7]]])
    at_rest = simulator.standing(replace(state, pos=pos, vel=np.zeros_like(pos), velocity_history=None), simulator.builder.metadata)
    (after,) = in_python(simulator, at_rest, 1)
    stays = (after.pos.numpy() == pos).all(axis=1)
    assert stays[:49].any() and not stays[49:].any()
    leans, fallen = slice(49, 49 + 25), -9.81 * simulator.builder.metadata.frame_dt
    assert after.vel[leans, 1].mean() == pytest.approx(fallen, abs=1e-9)  # a smooth wall does not rub
    assert np.abs(in_javascript(simulator, [at_rest], 1)["pos"][0] - after.pos.numpy()).max() < 1e-7


@pytest.mark.slow
def test_a_rollout_differs_as_much_as_rounding_makes_it(simulator: LearnedSimulator) -> None:
    state = scene(simulator, (FLOOR, SIDE, *OBSTACLES["solids"]))
    exact = in_python(simulator, state, 50)[-1].pos.numpy()
    moved = in_python(simulator, replace(state, pos=state.pos + 1e-9 * torch.sin(1e3 * state.pos)), 50)[-1].pos.numpy()
    found = in_javascript(simulator, [state], 50)["pos"][-1]
    error, of_rounding = (np.median(np.abs(pos - exact)) for pos in (found, moved))
    assert error < 20 * max(of_rounding, 1e-9)


@pytest.mark.slow
def test_plain_loops_compute_the_same(simulator: LearnedSimulator) -> None:
    state = scene(simulator, (FLOOR, *OBSTACLES["solids"]))
    compiled, plain = (in_javascript(simulator, [state], 3, plain) for plain in (False, True))
    assert not plain["compiled"]
    assert np.abs(compiled["pos"] - plain["pos"]).max() < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("kind", OBSTACLES)
def test_boundary_nodes_lie_where_python_puts_them(kind: str) -> None:
    simulator = LearnedSimulator.from_checkpoint("sand")
    state = scene(simulator, (FLOOR, SIDE, *OBSTACLES[kind]))
    found = in_javascript(simulator, [state], 0)

    def rows(pos: Any, normal: Any) -> np.ndarray:
        values = np.round(np.concatenate([np.reshape(pos, (-1, 2)), np.reshape(normal, (-1, 2))], axis=1), 9) + 0.0
        return values[np.lexsort(values.T[::-1])]

    np.testing.assert_allclose(rows(found["boundary"], found["normal"]), rows(state.boundary.pos, state.boundary.normal), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elastomer", "fem", "fluid"])
def test_other_models_are_refused_with_what_the_page_computes(name: str) -> None:
    with pytest.raises(PageError, match="particles in 2D, and not a model"):
        model_for_page(LearnedSimulator.from_checkpoint(name))


def test_the_parts_are_in_the_package() -> None:
    assert {path.suffix for path in Path(PARTS).iterdir()} == {".mjs", ".html", ".css"}


def test_pages_refuse_what_they_would_compute_otherwise() -> None:
    for name, value, message in (
        ("mirror_average", True, "averages over mirror images"),
        ("clamps_parameters", False, "does not clamp material parameters"),
    ):
        simulator = LearnedSimulator.from_checkpoint("sand")
        setattr(simulator, name, value)
        with pytest.raises(PageError, match=message):
            model_for_page(simulator)
    simulator = LearnedSimulator.from_checkpoint("sand")
    state, spacing = scene(simulator, (FLOOR,)), simulator.builder.metadata.spacing
    points = replace(state, boundary=replace(state.boundary, shapes=()))
    with pytest.raises(PageError, match="boundary has points only"):
        state_for_page(points, [0], spacing)
    walls = state.boundary
    longer: dict[str, Any] = {name: torch.cat([x, x[:1]]) for name, x in vars(walls).items() if isinstance(x, torch.Tensor)}
    longer["pos"][-1] += 0.2
    ledge = replace(walls, **longer)
    with pytest.raises(PageError, match="some of its nodes are on none of them"):
        state_for_page(replace(state, boundary=ledge), [0], spacing)
    slippery = replace(walls, friction=0.1 * walls.friction)
    with pytest.raises(PageError, match=r"boundary_node \d+ has the friction .*, the shape there .*; give both the same"):
        state_for_page(replace(state, boundary=slippery), [0], spacing)
    moving = replace(state, boundary=replace(state.boundary, vel=state.boundary.vel + 1.0))
    with pytest.raises(PageError, match="walls and obstacles that stand still"):
        state_for_page(moving, [0], spacing)
    for other in (
        Boundary.sample((FLOOR,), 2 * spacing, 2),
        replace(Boundary.sample((FLOOR,), spacing, 2), restitution=np.full(len(walls.pos), 0.5)),
    ):
        with pytest.raises(
            PageError, match=r"pages have boundary nodes 0.0\d+ m apart on all walls and obstacles, and this scene has others"
        ):
            state_for_page(replace(state, boundary=other), [0], spacing)
    own = simulator.builder.metadata
    film = rollout(Contained(simulator, own.frame_dt), state, 2, own)
    check_film(own, film)
    for change in ({"gravity": (0.0, -1.62)}, {"bounds": ((0.0, 2.0), (0.0, 1.0))}):
        with pytest.raises(PageError, match=f"the scene has {next(iter(change))}="):
            check_film(own, replace(film, metadata=replace(own, **change)))  # type: ignore[arg-type]


def test_removing_counts_only_if_something_is_removed() -> None:
    """A scene whose particles are all gone has no edges."""
    script = f"""
const {{ World }} = await import("{PARTS}/world.mjs");
const world = Object.create(World.prototype), numbers = (...values) => new Float64Array(values);
const model = {{ history: 0, parameters: [], spacing: 0.02, bounds: [[0, 1], [0, 1]] }};
const state = {{ count: 1, pos: numbers(0.5, 0.5), vel: numbers(0, 0), mass: numbers(1), block: numbers(0), history: numbers(), params: numbers() }};
const wall = {{ kind: "sphere", center: [0.8, 0.8], radius: 0.3 }};
Object.assign(world, {{ model, state, unit: 1, shapes: [wall], numBlocks: 1, untouched: true, last: {{ edges: 7 }} }});
const found = [world.removeAt(0.1, 0.1), world.addBlock(0.8, 0.8, 0.02), world.untouched, world.removeAt(0.5, 0.5), world.untouched, world.last.edges];
console.log(JSON.stringify(found));
"""
    ran = subprocess.run([str(NODE), "--input-type=module", "-e", script], capture_output=True, text=True, check=True)
    assert json.loads(ran.stdout) == ["", 0, True, "block", False, 0]
