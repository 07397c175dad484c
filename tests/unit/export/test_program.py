"""A step on plain tensors equals the simulator's step, and its program runs without this package."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.export.program import DESCRIPTION, ExportedStep, export_model, scene_of
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig, history_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.state import State
from tests import scenes
from tests.programs import exported

SMALL: dict[Any, dict[str, Any]] = {
    GPE: {"num_message_passing_steps": 2, "hidden_channels": 8},
    GNS: {"num_message_passing_steps": 2, "hidden_channels": 8},
    DPINet: {"hidden_channels": 8},
    ContinuousConvNet: {"hidden_channels": 8},
}


def simulator(
    model: Any = GPE,
    materials: tuple[str, ...] = ("sand",),
    dim: int = 2,
    config: dict[str, Any] | None = None,
    periodic: tuple[bool, ...] = (),
    **settings: Any,
) -> LearnedSimulator:
    """Return a simulator with random weights whose accelerations are of the order of gravity."""
    build = scenes.builder(materials, dim, **{"islands": False, **(config or {})})
    build = GraphBuilder(build.config, replace(build.metadata, periodic=periodic))
    torch.manual_seed(0)
    made = LearnedSimulator(model(build.spec, **{**SMALL[model], **settings}), build).eval()
    made.acceleration_std.fill_(30.0)
    made.stress_std.fill_(1e5)
    return made


def assert_same_step(step: Any, learned: LearnedSimulator, state: State, atol: float = 1e-9) -> None:
    expected, scene = learned.step(state), scene_of(learned, state)
    with torch.inference_mode():
        result, further = step(scene)
    for material, rows in {m: learned.builder(state)[m].node_id for m in learned.builder.spec.materials}.items():
        if len(rows):
            apart = state.periodicity.shortest(result[f"pos.{material}"] - expected.pos[rows])
            torch.testing.assert_close(apart, torch.zeros_like(apart), rtol=0, atol=atol)
            torch.testing.assert_close(result[f"velocity_history.{material}"], history_of(expected)[rows], rtol=0, atol=200 * atol)
            if f"stress.{material}" in further:
                assert expected.stress is not None
                torch.testing.assert_close(further[f"stress.{material}"], expected.stress.node[rows], rtol=1e-5, atol=1.0)
    assert float(state.periodicity.shortest(expected.pos - state.pos).abs().max()) > 1e4 * atol


def at_the_seam(state: State, learned: LearnedSimulator) -> State:
    """Return the scene in a periodic domain, moved so that the part near its lower corner lies on both sides of the seam."""
    space = learned.builder.metadata.periodicity
    moved = [0.8 if repeats else 0.0 for repeats in space.periodic]
    return replace(state, pos=space.wrapped(state.pos + moved), periodicity=space)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("features", ["paper", "contact"])
@pytest.mark.parametrize("model", SMALL)
def test_particles(model: Any, features: str, dim: int) -> None:
    learned = simulator(model, ("sand", "snow"), dim, {"features": features, "history": 3})
    assert_same_step(ExportedStep(learned), learned, scenes.state(materials=("sand", "snow"), history=3, dim=dim).to_torch())


def test_a_program_has_the_scale_of_the_copy_that_is_exported() -> None:
    learned = simulator(GPE, ("sand",), 2, {"history": 3, "scales": "dimensionless"}).at(0.8 * scenes.SPACING, 0.007)
    assert_same_step(ExportedStep(learned), learned, scenes.state(materials=("sand",), history=3).to_torch())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["triangles", "lattice", "tetrahedra"])
@pytest.mark.parametrize("model", [GPE, GNS, DPINet])
def test_meshes(model: Any, kind: Any) -> None:
    materials, dim = ("sand", "solid", "elastomer"), 3 if kind == "tetrahedra" else 2
    settings: dict[str, Any] = (
        {"stress": True, "level_weights": "separate", "decoder": "contact", "island_momentum": "linear"} if model is GPE else {}
    )
    learned = simulator(model, materials, dim, {"mesh": True, "num_levels": 3, "islands": model is GPE}, **settings)
    assert_same_step(ExportedStep(learned), learned, scenes.mesh_state(kind, materials, num_bodies=3).to_torch())


@pytest.mark.parametrize("kind", ["particles", "triangles", "lattice", "tetrahedra"])
def test_graphs_of_programs_are_those_of_the_builder(kind: str) -> None:
    """Bit for bit, if the state has its nodes in the order of their materials, as programs have them."""
    materials, dim = ("sand", "elastomer", "solid"), 3 if kind == "tetrahedra" else 2
    learned = simulator(GPE, materials, dim, {"mesh": True, "num_levels": 3, "islands": True, "trim_boundary": False, "history": 2})
    shuffled = scenes.state(materials=materials, history=2) if kind == "particles" else scenes.mesh_state(kind, materials, 3, history=2)
    state = scenes.permuted(shuffled, np.argsort(shuffled.node_type, kind="stable")).to_torch()
    step, scene, expected = ExportedStep(learned), scene_of(learned, state), learned.builder(state)
    graph = learned.builder.graph(step.topology(scene), step.state(scene))
    assert int(graph.num_bodies) >= int(expected.num_bodies)
    graph.num_bodies = expected.num_bodies  # an upper bound in programs
    scenes.assert_equal_graphs(graph, expected)


@pytest.mark.parametrize("loose", [False, True])
def test_descent_follows_from_parents(loose: bool) -> None:
    """This also holds for nodes without a cell, and for bodies whose root is below the highest level."""
    state = scenes.mesh_state("lattice", ("elastomer",), num_bodies=3)
    assert state.cells is not None
    cells = state.cells[::3] if loose else state.cells
    learned = simulator(GPE, ("elastomer",), 2, {"mesh": True, "num_levels": 4})
    changed = replace(state, cells=cells).to_torch()
    expected = learned.builder.topology(changed).mesh
    found = ExportedStep(learned).topology(scene_of(learned, changed)).mesh
    assert expected is not None and found is not None and found.num_virtual == expected.num_virtual
    pairs = {*zip(*found.descent.tolist(), strict=True)}
    without = {(above, node) for above, node in pairs if above == sum(found.num_virtual)}
    assert pairs - without == {*zip(*expected.descent.tolist(), strict=True)}
    assert bool(without)


@pytest.mark.parametrize("dim", [2, 3])
def test_islands_keep_their_momentum(dim: int) -> None:
    learned = simulator(dim=dim, config={"islands": True}, island_momentum="angular")
    assert_same_step(ExportedStep(learned), learned, scenes.state(materials=("sand",), dim=dim, low=0.1, high=0.9).to_torch())


@pytest.mark.parametrize("push", [0.0, 0.3])
def test_static_friction(push: float) -> None:
    learned = simulator(config={"islands": True}, island_momentum="angular")
    state = scenes.state(materials=("sand",), high=0.7)
    floor = (state.boundary.pos[:, 1] <= 0) & (state.boundary.pos[:, 0] < 0.5)
    vel = np.where(floor[:, None], [push, 0.0], 0.0)
    gravity = np.array([0.0, 400.0])  # against which this untrained network pulls
    slow = replace(
        state,
        vel=0.01 * state.vel,
        velocity_history=None,
        gravity=gravity,
        boundary=replace(state.boundary, vel=vel, normal=-state.boundary.normal),
    ).to_torch()
    learned.static_friction = 0.99
    held = (learned.step(slow).pos == slow.pos).all(dim=1)
    assert 0 < held.sum() < len(held)
    assert_same_step(ExportedStep(learned), learned, slow)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("model", SMALL)
def test_periodic_clouds(model: Any, dim: int) -> None:
    settings: dict[str, Any] = {"island_momentum": "angular"} if model is GPE else {}
    learned = simulator(model, ("sand", "snow"), dim, {"islands": model is GPE}, (True, True, False)[-dim:], **settings)
    state = at_the_seam(scenes.state(materials=("sand", "snow"), dim=dim, walls=False), learned)
    assert_same_step(ExportedStep(learned), learned, state.to_torch())


@pytest.mark.parametrize("kind", ["triangles", "lattice", "tetrahedra"])
def test_periodic_meshes(kind: Any) -> None:
    materials, dim = ("sand", "solid"), 3 if kind == "tetrahedra" else 2
    config = {"mesh": True, "num_levels": 2, "islands": True}
    learned = simulator(GPE, materials, dim, config, (True,) * dim, stress=True, island_momentum="angular", decoder="contact")
    state = at_the_seam(scenes.mesh_state(kind, materials, walls=False), learned)
    assert_same_step(ExportedStep(learned), learned, state.to_torch())


def test_what_a_file_cannot_be_is_refused(tmp_path: Path) -> None:
    learned = simulator()
    with pytest.raises(ValueError, match=r"an exported program ends in \.pt2"):
        export_model(learned, tmp_path / "model.pt")
    assert not [*tmp_path.iterdir()]


ELSEWHERE = """
import json, sys
import numpy as np, torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

path, start, stop, num_steps = *sys.argv[1:4], int(sys.argv[4])
files = {"description.json": ""}
program = torch.export.load(path, extra_files=files).module()
radius = json.loads(files["description.json"])["connectivity_radius"]
scene = {name: torch.from_numpy(values) for name, values in np.load(start).items()}
for _ in range(num_steps):
    pos, boundary = scene["pos.sand"].numpy(), scene["boundary.pos"].numpy()
    tree = cKDTree(pos)
    pairs = tree.query_pairs(radius, output_type="ndarray").T.astype(np.int64)
    scene["edges.sand.radius.sand"] = torch.from_numpy(pairs)
    near = cKDTree(boundary).sparse_distance_matrix(tree, radius, output_type="ndarray")
    scene["edges.boundary.radius.sand"] = torch.from_numpy(np.stack([near["i"], near["j"]]).astype(np.int64))
    count, island = connected_components(coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(len(pos), len(pos))), directed=False)
    scene["island.sand"] = torch.from_numpy(island.astype(np.int64))
    scene["num_islands"] = torch.empty(count, 0, dtype=torch.float64)
    with torch.inference_mode():
        moved, predicted = program(scene)
    scene |= moved
np.savez(stop, **{name: values.numpy() for name, values in (scene | predicted).items()})
assert not {"gpe_pl", "torch_geometric", "numba", "lightning"} & {name.partition(".")[0] for name in sys.modules}
"""


@pytest.mark.slow
def test_a_rollout_in_a_process_without_this_package(tmp_path: Path) -> None:
    """More nodes and edges than in the example from which the program was made, and other numbers of edges in every frame."""
    learned, num_steps = simulator(config={"history": 2, "islands": True}, island_momentum="angular"), 6
    state = scenes.state(history=2, low=0.03, high=0.9).to_torch()  # sparse enough for islands that fly
    exported(learned, tmp_path / "model.pt2")
    start: dict[str, Any] = {name: values.numpy() for name, values in scene_of(learned, state).items()}
    np.savez(tmp_path / "start.npz", **start)
    files = [str(tmp_path / name) for name in ("model.pt2", "start.npz", "stop.npz")]
    child = subprocess.run(
        [sys.executable, "-I", "-W", "ignore", "-c", ELSEWHERE, *files, str(num_steps)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert child.returncode == 0, child.stderr
    expected = rollout(learned, state, num_steps, learned.builder.metadata)
    np.testing.assert_allclose(np.load(tmp_path / "stop.npz")["pos.sand"], expected.pos[-1], rtol=0, atol=1e-7)
    assert np.abs(expected.pos[-1] - expected.pos[0]).max() > 0.01
    stop = np.load(tmp_path / "stop.npz")
    touching = np.unique(stop["island.sand"][stop["edges.boundary.radius.sand"][1]])
    assert 0 < len(touching) <= stop["island.sand"].max()  # some islands fly


@pytest.mark.slow
def test_a_program_serves_any_numbers_of_nodes_and_edges(tmp_path: Path) -> None:
    learned = simulator(materials=("sand", "snow"), config={"islands": True}, island_momentum="angular")
    files = {DESCRIPTION: ""}
    program = torch.export.load(exported(learned, tmp_path / "model.pt2"), extra_files=files).module()
    two = scenes.state(2, ("sand", "snow"), walls=False)
    for state in (scenes.state(60, ("sand", "snow")), two, scenes.permuted(two, np.array([1]))):  # the last one has no sand and no edges
        assert_same_step(program, learned, state.to_torch())
    description = json.loads(files[DESCRIPTION])
    assert description["connectivity_radius"] == learned.builder.scales.radius
    assert description["inputs"]["velocity_history.sand"]["shape"] == ["sand", 1, 2]
    assert set(description["inputs"]) == set(scene_of(learned, state.to_torch()))


@pytest.mark.long
def test_a_program_of_a_periodic_domain(tmp_path: Path) -> None:
    learned = simulator(
        materials=("sand", "solid"), config={"mesh": True, "islands": True}, periodic=(True, True),
        island_momentum="angular", decoder="contact",
    )  # fmt: skip
    files = {DESCRIPTION: ""}
    program = torch.export.load(exported(learned, tmp_path / "model.pt2"), extra_files=files).module()
    for seed in (0, 1):
        state = at_the_seam(scenes.mesh_state("triangles", ("sand", "solid"), walls=False, seed=seed), learned)
        assert_same_step(program, learned, state.to_torch())
    description = json.loads(files[DESCRIPTION])
    assert (description["bounds"], description["periodic"]) == ([[0.0, 1.0], [0.0, 1.0]], [True, True])
    assert description["trained"] == dict(learned.described_training())
    assert {"friction_angle of sand", "gravity", "spacing of boundary nodes"} <= {*description["trained"]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "kind"),
    [
        *((m, "particles") for m in SMALL),
        (GPE, "no parameter"),
        (GPE, "bodies"),
        *(pytest.param(m, "mesh", marks=pytest.mark.long) for m in (GPE, GNS, DPINet)),
    ],
)
def test_every_model_becomes_a_program(model: Any, kind: str, tmp_path: Path) -> None:
    config = {"mesh": True, "num_levels": 2, "islands": model is GPE} if kind in ("mesh", "bodies") else {}
    settings: dict[str, Any] = {"stress": True, "island_momentum": "angular"} if config and model is GPE else {}
    if kind == "no parameter":
        settings["material_embedding"] = "none"
    if kind == "bodies":
        settings["decoder"] = "contact"
    materials, dim = (("sand", "solid"), 3) if config else (("sand",), 2)
    learned = simulator(model, materials, dim, config, **settings)
    program = torch.export.load(exported(learned, tmp_path / "model.pt2")).module()
    for seed in (0, 1):
        state = scenes.mesh_state("tetrahedra", materials, seed=seed) if config else scenes.state(seed=seed, num_nodes=30 + seed)
        assert_same_step(program, learned, state.to_torch(), atol=1e-8 if kind == "bodies" else 1e-9)  # forces over small masses are large


def test_the_configuration_of_graphs_is_that_of_the_simulator() -> None:
    """Boundary nodes without edges change nothing: programs take all of them."""
    learned = simulator()
    assert learned.builder.config == GraphConfig(history=1) and isinstance(learned.builder, GraphBuilder)
    scene = scene_of(learned, scenes.state().to_torch())
    assert scene["boundary.pos"].shape == scenes.state().boundary.pos.shape
