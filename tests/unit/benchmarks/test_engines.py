"""Other engines: their input and output files, their failures, and the table of differences. Runs of an engine are skipped where it is not installed."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from gpe_pl.benchmarks.acceptance.scenes import block
from gpe_pl.benchmarks.acceptance.trial import Candidate
from gpe_pl.benchmarks.outside import calculix, engines, kratos, splishsplash
from gpe_pl.benchmarks.outside.engine import EngineError, Motion
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.schema import node_code
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.fem.elements import build_mesh, cauchy_stress
from gpe_pl.solvers.materials import Sand, lame_parameters
from gpe_pl.solvers.solid_scenes import lumped_masses
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

UNIT_SQUARE, UNIT_CUBE = ((0.0, 1.0),) * 2, ((0.0, 1.0),) * 3
SPACING = 0.05


def falling_block(height: float, speed: float) -> State:
    nodes, cells = block(4, 3)
    pos = np.array([0.4, height]) + SPACING * nodes
    return State(
        pos, np.full(pos.shape, [0.0, -speed]), np.full(len(pos), node_code("solid"), np.uint8), lumped_masses(pos, cells, 1000.0),
        np.full((len(pos), 1), 1e6), Boundary.sample(domain_walls(UNIT_SQUARE, 0.3), SPACING, 2), np.array([0.0, -9.81]),
        rest_pos=pos.copy(), cells=cells,
    )  # fmt: skip


def cube_of_liquid(viscosity: float) -> State:
    lattice = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5
    pos = SPACING * lattice
    return State(
        pos, np.zeros_like(pos), np.full(len(pos), node_code("fluid"), np.uint8), np.full(len(pos), 1000 * SPACING**3),
        np.full((len(pos), 1), viscosity), Boundary.empty(3), np.array([0.0, 0.0, -9.81]),
    )  # fmt: skip


def column_of_sand(friction_angle: float) -> State:
    pos = np.array([0.4, 0.0]) + SPACING * (np.stack(np.meshgrid(np.arange(4), np.arange(6), indexing="ij"), -1).reshape(-1, 2) + 0.5)
    return State(
        pos, np.zeros_like(pos), np.full(len(pos), node_code("sand"), np.uint8), np.full(len(pos), 1600 * SPACING**2),
        np.full((len(pos), 1), friction_angle), Boundary.empty(2), np.array([0.0, -9.81]),
    )  # fmt: skip


def test_displacements_and_velocities_are_read_by_frame_and_node() -> None:
    table = "\n displacements (vx,vy,vz) for set FRONT and time  0.1E-02\n\n 1 1.0E-01 2.0E-01 0.0\n 2 3.0E-01 4.0E-01 0.0\n\n"
    fast = table.replace("displacements", "velocities").replace("E-01", "E+01")
    text = table + fast + table.replace("1.0E-01", "5.0E-01") + table.partition(" 2 ")[0]
    np.testing.assert_allclose(calculix.of_nodes(text, "displacements", 2), [[[0.1, 0.2], [0.3, 0.4]], [[0.5, 0.2], [0.3, 0.4]]])
    np.testing.assert_allclose(calculix.of_nodes(text, "velocities", 2), [[[10, 20], [30, 40]]])


def test_the_stress_of_a_cell_is_the_mean_of_its_two_points_in_the_order_of_states() -> None:
    heading = "\n stresses (elem, integ.pnt.,sxx,syy,szz,sxy,sxz,syz) for set BODY and time  0.1E-02\n\n"
    points = " 1 1 1.0 2.0 3.0 4.0 0.0 0.0\n 1 2 3.0 2.0 3.0 4.0 0.0 0.0\n 2 1 5.0 6.0 7.0 8.0 0.0 0.0\n 2 2 5.0 6.0 7.0 8.0 0.0 0.0\n"
    moved = "\n displacements (vx,vy,vz) for set FRONT and time  0.1E-02\n\n 1 1.0E-01 2.0E-01 0.0\n"
    text = moved + heading + points + moved + heading + points.partition(" 2 2")[0]
    np.testing.assert_allclose(
        calculix.cell_stresses(text, 2), [[[2, 4, 2, 3], [5, 8, 6, 7]]]
    )  # xx, xy, yy, zz; the second frame is not whole
    assert calculix.of_nodes(text, "displacements", 1).shape == (2, 1, 2)


def test_a_deck_has_the_mesh_twice_its_material_and_its_skin() -> None:
    state = falling_block(0.1, 1.0)
    lines = calculix.deck(state, FEM(UNIT_SQUARE, 2e-3, poisson_ratio=0.25), 5, 20, 0.1).splitlines()
    assert sum(len(line.split(",")) == 7 for line in lines) == len(state.cells)  # type: ignore[arg-type]
    mu = 1e6 / 2.5
    neo_hooke = [float(x) for x in lines[lines.index("*HYPERELASTIC, NEO HOOKE") + 1].split(",")]
    np.testing.assert_allclose(neo_hooke, [mu / 2, 2 / (mu + 2 * mu / 3)])  # λ = μ for this ratio
    skin = lines[lines.index("*SURFACE, NAME=SKIN, TYPE=NODE") + 1 : lines.index("*SURFACE, NAME=TOP, TYPE=ELEMENT")]
    assert len(skin) == 2 * 14  # 2 (4 + 3) nodes of the outline, in both layers


@pytest.mark.skipif(sys.platform == "win32", reason="the program is a shell script")
def test_a_failure_has_the_last_lines_of_the_engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "ccx"
    program.write_text("#!/bin/sh\necho one\necho '*ERROR: solution seems to diverge'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with pytest.raises(EngineError, match=r"has 0 of 3 frames.*one / \*ERROR: solution seems to diverge"):
        calculix.run(falling_block(0.1, 1.0), FEM(UNIT_SQUARE, 2e-3), 4)


@pytest.mark.skipif(sys.platform == "win32", reason="the program is a shell script")
def test_a_scene_that_the_engine_gives_up_is_tried_with_stiffer_sticking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = falling_block(0.1, 1.0)
    rows = "".join(f"{node} 0.25 -0.5 0.0\n" for node in range(1, state.num_nodes + 1))
    stresses = "".join(f"{cell} {point} 2.0 0.0 0.0 0.0 0.0 0.0\n" for cell in range(1, len(state.cells) + 1) for point in (1, 2))  # type: ignore[arg-type]
    tables = {"displacements": rows, "velocities": rows, "stresses": stresses}
    (tmp_path / "found.dat").write_text("".join(f" {quantity} for set X\n\n{lines}\n" for quantity, lines in tables.items()))
    program = tmp_path / "ccx"
    again = f"cp scene.inp {tmp_path}/2.inp; cp {tmp_path}/found.dat scene.dat"
    program.write_text(f"#!/bin/sh\nif [ -e {tmp_path}/1.inp ]; then {again}; else cp scene.inp {tmp_path}/1.inp; fi\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    motion = calculix.run(state, FEM(UNIT_SQUARE, 2e-3), 2)
    np.testing.assert_allclose(motion.pos[1] - motion.pos[0], np.tile([0.25, -0.5], (state.num_nodes, 1)))
    assert motion.stress is not None and motion.vel is not None
    np.testing.assert_array_equal(motion.vel[0], state.vel)
    np.testing.assert_allclose(motion.vel[1], motion.pos[1] - motion.pos[0])  # the same numbers in the file
    for stress in (motion.stress.node, motion.stress.cell):
        assert not stress[0].any()  # the initial state is the rest configuration
        np.testing.assert_allclose(stress[1], np.tile([2.0, 0.0, 0.0, 0.0], (stress.shape[1], 1)))
    first, second = ((tmp_path / name).read_text().splitlines() for name in ("1.inp", "2.inp"))
    sticking = [float(lines[lines.index("*FRICTION") + 1].split(",")[1]) for lines in (first, second)]
    assert sticking[1] == pytest.approx(10 * sticking[0])


def test_points_are_big_endian_with_a_weight() -> None:
    data = splishsplash.points_file(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    assert data[:5] == b"BgeoV" and struct.unpack(">2i", data[5:13]) == (5, 2)
    np.testing.assert_array_equal(np.frombuffer(data[41:73], ">f4").reshape(2, 4), [[1, 2, 3, 1], [4, 5, 6, 1]])


def test_a_particle_is_a_square_around_it_and_walls_are_the_rim_of_the_grid() -> None:
    body = kratos._body(np.array([[0.3, 0.4], [0.5, 0.4]]), 0.1).splitlines()
    corners = np.array([[float(x) for x in line.split()[1:3]] for line in body[body.index("Begin Nodes") + 1 : body.index("End Nodes")]])
    np.testing.assert_allclose(corners.reshape(2, 4, 2).mean(axis=1), [[0.3, 0.4], [0.5, 0.4]])
    (ax, ay), (bx, by) = (corners[1] - corners[0]), (corners[2] - corners[1])
    assert ax * by - ay * bx > 0  # the corners run counterclockwise
    grid = kratos._grid(((0.0, 1.0), (0.0, 0.5)), 0.25)
    walls = grid[grid.index("Begin SubModelPart Walls") :].split("Begin SubModelPartNodes\n")[1].split("End")[0].split()
    assert len(walls) == 12 and grid.count("\n") > 15  # all nodes of 5 × 3 but the 3 inside


def test_particles_that_an_engine_lost_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fewer(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        np.save(Path(command[3]) / "frames.npy", np.zeros((3, 5, 2)))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", fewer)
    with pytest.raises(EngineError, match=r"has frames and nodes \(3, 5\), expected \(3, 24\)"):
        kratos.run(column_of_sand(30.0), Sand(), UNIT_SQUARE, SPACING, 5e-3, 3)


def record(model: list[float]) -> dict[str, object]:
    about = {"engine_name": "calculix", "model": "m", "parameter": "E", "spacing": 0.5, "quantity": "height", "x": [0.0, 1.0]}
    return about | {"engine": [1.0, 2.0], "solver": [1.5, 2.5], "model": model}


def test_differences_are_means_in_spacings_until_a_model_stopped() -> None:
    assert engines.difference([1.0, 2.0, 9.0], [1.5, 2.5], 0.5) == 1.0
    whole = next(line for line in engines.report([record([2.0, 2.0])]) if line.startswith("| CalculiX"))
    assert whole == "| CalculiX | E | height | 2.0 | 1.00 | 1.00 | 1.00 |"
    assert "2.00 until it stopped" in "".join(engines.report([record([2.0])]))
    assert engines.report([{"missing": "x"}]) == []
    assert engines.drawn([record([2.0])]).keys() == {"engines"} and engines.drawn([]) == {}


def test_engine_solver_and_model_are_compared_at_the_same_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of them are one node that rises by 1 m per frame; the model starts with the solver's third frame and stops after three more."""

    def rising(first: int, last: int) -> SimpleNamespace:
        pos = np.arange(first, last, dtype=float)[:, None, None] * np.array([0.0, 1.0])
        return SimpleNamespace(pos=pos, frames=lambda start: rising(first + start, last))

    solver = SimpleNamespace(frame_dt=0.1)
    builder = SimpleNamespace(config=SimpleNamespace(history=2))
    candidate, spec = Mock(spec=Candidate), Mock(spec=DatasetSpec)
    spec.configure_mock(solver=solver, scene=SimpleNamespace(materials=("solid",), bounds=UNIT_SQUARE))
    candidate.configure_mock(
        name="m", spacing=0.5, values=(1.0, 2.0, 3.0), described=str, metadata=lambda: None,
        spec=spec,
        simulator=SimpleNamespace(builder=builder, initial_state=lambda *_: None),
    )  # fmt: skip
    monkeypatch.setattr(engines, "rollout", lambda _solver, _start, count, _metadata: rising(0, count + 1))
    monkeypatch.setattr(engines, "predicted", lambda _candidate, _state, _truth: (rising(2, 6), 0.0))
    scene = replace(
        engines.SCENES["calculix"],
        start=lambda *_: falling_block(0.1, 1.0),
        run=lambda _c, _s, count: Motion(rising(0, count).pos + np.array([0.0, 0.25])),
        seconds=8.0,
    )
    monkeypatch.setitem(engines.SCENES, "calculix", scene)
    height, apart = engines.compared("calculix", candidate)
    assert height["x"][:2] == [0.2, 0.4] and len(height["x"]) == 41  # every second one of 81 frames
    assert height["solver"][:2] == [2.0, 4.0] and height["engine"][:2] == [2.25, 4.25] and height["model"] == [2.0, 4.0]
    assert apart["solver"] == [0.25] * 41 and apart["model"] == [0.25, 0.25]
    assert engines.compared("kratos", candidate) == []


@pytest.mark.slow
def test_calculix_lets_a_block_fall_and_bounce() -> None:
    if calculix.is_missing():
        pytest.skip("ccx is not on the path")
    solver = FEM(UNIT_SQUARE, 2e-3)
    pos = calculix.run(falling_block(0.02, 1.0), solver, 40).pos
    times = 2e-3 * np.arange(8)
    np.testing.assert_allclose(
        pos[:8] - pos[0], np.array([0.0, 1.0]) * (-times - 9.81 / 2 * times**2)[:, None, None] * np.ones((8, 20, 1)), atol=1e-6
    )
    height = pos[..., 1].mean(axis=1)
    assert height[-1] > height.min() + 0.005 and pos[..., 1].min() > -0.1 * SPACING


@pytest.mark.slow
def test_a_body_of_calculix_swings_as_that_of_the_solver_and_has_the_stress_of_its_law() -> None:
    """A block is released with a velocity that stretches it, and swings in free fall."""
    if calculix.is_missing():
        pytest.skip("ccx is not on the path")
    still = falling_block(0.5, 0.0)
    pos, solver, count = np.asarray(still.pos), FEM(UNIT_SQUARE, 1e-3), 40
    own = [replace(still, vel=(pos - pos.mean(axis=0)) * [4.0, 0.0])]
    motion = calculix.run(own[0], solver, count)
    while len(own) < count:
        own.append(solver.step(own[-1]))
    lengths = [np.ptp(p[..., 0], axis=1) / np.ptp(pos[:, 0]) - 1 for p in (motion.pos, np.stack([np.asarray(state.pos) for state in own]))]
    first, second, third = ([max(length[k : k + 10]) for length in lengths] for k in (0, 10, 25))
    assert third[1] < first[1] / 2.5  # damping slows it
    for swing in (second, third):
        assert swing[0] / first[0] == pytest.approx(swing[1] / first[1], rel=0.15)
    mesh = build_mesh(pos, np.asarray(still.cells), np.asarray(still.mass))
    lam, mu = (np.full(len(mesh.cells), value) for value in lame_parameters(1e6, solver.poisson_ratio))
    assert motion.stress is not None and motion.vel is not None
    between = (motion.pos[2:] - motion.pos[:-2]) / 2e-3
    assert np.linalg.norm(motion.vel[1:-1] - between) < 0.05 * np.linalg.norm(between)
    for frame in range(2, count, 5):
        expected = cauchy_stress(mesh, motion.pos[frame], lam, mu)
        for name in ("node", "cell"):
            found, law = getattr(motion.stress, name)[frame], getattr(expected, name)
            assert np.linalg.norm(found - law) < 0.02 * np.linalg.norm(law), (frame, name)


@pytest.mark.slow
def test_splishsplash_spreads_a_thin_liquid_further_than_a_thick_one() -> None:
    if splishsplash.is_missing():
        pytest.skip("pysplishsplash is not installed")
    thin, thick = (splishsplash.run(cube_of_liquid(v), UNIT_CUBE, SPACING, 5e-3, 30) for v in (2e-3, 0.5))
    np.testing.assert_allclose(thin[0], cube_of_liquid(1.0).pos, atol=0.3 * SPACING)
    assert thin.shape == thick.shape == (30, 64, 3)
    assert thin[-1, :, 0].max() > 1.2 * thick[-1, :, 0].max()
    assert (thin > -0.1 * SPACING).all() and (thin < 1 + 0.1 * SPACING).all()


@pytest.mark.slow
def test_kratos_lets_a_column_of_sand_collapse_further_with_less_friction() -> None:
    if kratos.is_missing():
        pytest.skip("KratosMPMApplication is not installed")
    loose, firm = (kratos.run(column_of_sand(angle), Sand(), UNIT_SQUARE, SPACING, 5e-3, 50) for angle in (15.0, 40.0))
    np.testing.assert_allclose(loose[0], column_of_sand(0.0).pos, atol=1e-6)
    widths = [np.ptp(pos[-1, :, 0]) for pos in (loose, firm)]
    assert widths[0] > 1.1 * widths[1] > 1.1 * 4 * SPACING * 0.9
