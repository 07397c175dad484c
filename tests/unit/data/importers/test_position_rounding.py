"""Data that float32 would destroy are moved or named, and so are steps that no model can follow."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure, ImportSettings, Report, import_dataset, save_dataset
from gpe_pl.data.importers.sampled import degrees_of
from gpe_pl.data.importers.source import joined
from gpe_pl.data.position_rounding import motion_of
from gpe_pl.data.validate import validate
from gpe_pl.geometry.shapes import Shape, Sphere, domain_walls
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Trajectory
from tests import sources
from tests.sources import DT, SPACING

OFFSET = np.array([5000.0, -70000.0])


def swinging(seed: int = 0, num_frames: int = 12) -> np.ndarray:
    """Return positions [frame, node, dim] in double precision of a lattice whose nodes swing by millimetres."""
    rng = np.random.default_rng(seed)
    lattice = 0.3 + SPACING * np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1).reshape(-1, 2)
    phase = rng.uniform(0, 2 * np.pi, lattice.shape)
    return lattice + 0.02 * np.sin(8 * DT * np.arange(num_frames)[:, None, None] + phase)


def converted(tmp_path: Path, name: str, arrays: list[np.ndarray], **changes: Any) -> Report:
    folder = tmp_path / f"{name}_raw"
    folder.mkdir()
    for k, pos in enumerate(arrays):
        np.savez(folder / f"{k}.npz", pos=pos, frame_dt=DT, materials="sand", params_sand=30.0, **changes)
    return import_dataset(tmp_path, ImportSettings("arrays", str(folder), name))


def stored(report: Report) -> list[Trajectory]:
    """Return the stored trajectories in the source's order; missing splits come from the end of train, ``val`` first."""
    return [t for split in ("train", "test", "val") for t in iter_trajectories(Path(report.folder), split)]


@pytest.mark.slow
def test_far_from_the_origin_accelerations_survive(tmp_path: Path) -> None:
    near = [swinging(seed) for seed in range(4)]
    here = converted(tmp_path, "near", near)
    assert here.origin == [0.0, 0.0]
    assert not [*here.warnings, *here.repairs]
    there = converted(
        tmp_path, "far", [pos + OFFSET for pos in near], boundary_pos=OFFSET + np.array([[0.4, 0.2]]), boundary_normal=[[0, 1]]
    )
    assert there.origin == OFFSET.tolist()
    assert there.acceleration_std == pytest.approx(here.acceleration_std, rel=1e-3)
    assert there.spacing == pytest.approx(here.spacing, rel=1e-6)
    (event,) = there.repairs
    assert str(event).startswith("all splits, all trajectories: the origin was moved to (5000, -70000) m: float32 would round")
    assert not there.warnings
    assert not validate([Path(there.folder)]).violations
    for trajectory, pos in zip(stored(there), near, strict=True):
        np.testing.assert_allclose(trajectory.pos, pos, atol=1e-7)
        np.testing.assert_allclose(trajectory.boundary.pos, [[0.4, 0.2]], atol=1e-6)
        assert json.loads(trajectory.metadata.config)["origin"] == OFFSET.tolist()
    np.testing.assert_allclose(there.bounds, here.bounds, atol=0.11)  # the wall point widens them


def test_everything_moves_with_the_origin(tmp_path: Path) -> None:
    far = [swinging(seed) + OFFSET for seed in range(3)]
    box = tuple((float(x), float(x) + 1.0) for x in OFFSET)
    shapes: tuple[Shape, ...] = (*domain_walls(box, 0.2), Sphere(tuple(OFFSET + 0.8), 0.1, 0.2))
    cells, boundary = [[0, 1, 7], [0, 7, 6]], Boundary.sample(shapes, SPACING, 2)
    made = [Trajectory.from_numpy(pos, DT, "solid", {"solid": 1e6}, bounds=box, boundary=boundary, cells=cells) for pos in far]
    report = save_dataset(tmp_path, "solid", train=made)
    assert not validate([Path(report.folder)]).violations
    for trajectory, original in zip(stored(report), made, strict=True):
        m, b = trajectory.metadata, trajectory.boundary
        assert m.bounds == ((0.0, 1.0), (0.0, 1.0))
        np.testing.assert_allclose(trajectory.pos, original.pos - OFFSET, atol=1e-7)
        assert trajectory.rest_pos is not None
        np.testing.assert_allclose(trajectory.rest_pos, original.pos[0] - OFFSET, atol=1e-7)
        np.testing.assert_allclose(b.pos, boundary.pos - OFFSET, atol=1e-7)
        points = swinging()[0]
        for shape, before in zip(b.shapes, shapes, strict=True):
            np.testing.assert_allclose(shape.signed_distance(points), before.signed_distance(points + OFFSET), atol=1e-9)


def test_nodes_at_one_place_are_named(tmp_path: Path) -> None:
    """Overlapping bodies have such nodes. A given spacing does not reveal them."""
    made = []
    for seed in range(3):
        pos = swinging(seed)
        pos[:, 5] = pos[:, 2]
        made.append(Trajectory.from_numpy(pos, DT, "sand", {"sand": 30.0}, spacing=SPACING))
    report = save_dataset(tmp_path, "sand", train=made)
    assert sorted(w for w in report.warnings if "do bodies overlap?" in w) == [
        f"{split}, train[{k}], frame 0: 2 nodes are at the place of another node, the first is node 2: do bodies overlap?"
        for k, split in ((1, "test"), (0, "train"), (2, "val"))
    ]


def test_rest_positions_of_their_own_stay_where_they_are(tmp_path: Path) -> None:
    rest = swinging()[0]
    made = [
        Trajectory.from_numpy(swinging(seed) + OFFSET, DT, "solid", {"solid": 1e6}, cells=[[0, 1, 7]], rest_pos=rest) for seed in range(3)
    ]
    report = save_dataset(tmp_path, "solid", train=made)
    found = stored(report)[0].rest_pos
    assert found is not None
    np.testing.assert_allclose(found, rest, atol=1e-7)


def test_a_periodic_domain_moves_too(tmp_path: Path) -> None:
    box = [[x, x + 1.0] for x in OFFSET]
    drift = 0.06 * np.arange(12)[:, None, None]
    report = converted(tmp_path, "far", [swinging(seed) + drift + OFFSET for seed in range(3)], bounds=box, periodic=[True, True])
    np.testing.assert_allclose(report.origin, OFFSET, atol=1.0)
    np.testing.assert_array_equal(report.bounds, np.array(box) - np.array(report.origin)[:, None])
    expected = Trajectory.from_numpy(swinging() + drift, DT, "sand", {"sand": 30.0}, bounds=[[0, 1], [0, 1]], periodic=[True, True])
    np.testing.assert_allclose(stored(report)[0].vel, expected.vel, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "offset"), [(np.float16, 0.0), (np.float32, 5000.0)])
def test_the_input_is_too_coarse(tmp_path: Path, precision: Any, offset: float) -> None:
    """Whatever type such numbers come in: what was rounded away does not come back."""
    rounded = [(swinging(seed) + offset).astype(precision) for seed in range(3)]
    for name, arrays in (("as_is", rounded), ("widened", [pos.astype(np.float64) for pos in rounded])):
        report = converted(tmp_path, name, arrays)
        assert report.origin == [0.0, 0.0]
        assert [w.partition(":")[0] for w in report.warnings] == ["train, 0.npz", "test, 1.npz", "val, 2.npz"]
        assert f"positions in {precision.__name__} round accelerations by " in report.text()
        assert re.search(r"by 3\.4\d m/s², those of the data are [234]\.\d+ m/s² rms: write them with more digits$", report.warnings[0])
        assert "write them with more digits" in (Path(report.folder) / "report.md").read_text()


def test_rounding_is_what_the_formula_says() -> None:
    exact = swinging(num_frames=300) + 5000.0
    trajectory = Trajectory.from_numpy(exact, DT, "sand", {"sand": 30.0})
    assert trajectory.pos.dtype == np.float64

    def acceleration(pos: np.ndarray) -> np.ndarray:
        vel = integrators.velocities(pos, DT)
        return np.asarray(integrators.acceleration(vel[1:], vel[:-1], DT))

    error = acceleration(exact.astype(np.float32).astype(np.float64)) - acceleration(exact)
    motion = motion_of(trajectory.metadata, trajectory.pos)
    np.testing.assert_allclose(motion.rounding(np.float32, np.zeros(2)), np.sqrt((error**2).mean(axis=(0, 1))), rtol=0.1)
    assert motion.acceleration == pytest.approx(np.sqrt((acceleration(exact) ** 2).mean()), rel=1e-6)
    other = np.array([0.3, -2.0])
    assert motion.with_gravity(other).acceleration == pytest.approx(np.sqrt(((acceleration(exact) - other) ** 2).mean()), rel=1e-6)


def test_frames_too_close_in_time_are_named(tmp_path: Path) -> None:
    slow = [np.repeat(swinging(seed)[:1], 12, axis=0) + 1e-9 * np.arange(12)[:, None, None] ** 2 for seed in range(3)]
    report = converted(tmp_path, "slow", slow)
    assert report.origin == [0.0, 0.0]
    rounding = next(w for w in report.warnings if "positions in float32 round accelerations by" in w)
    assert "take a larger time step" in rounding


@pytest.mark.parametrize("arrays", [{"pos": 1e30 * swinging()}, {"pos": swinging(), "vel": 1e30 * swinging()}])
def test_what_float32_cannot_hold_is_refused(arrays: dict[str, Any]) -> None:
    name = "vel" if "vel" in arrays else "pos"
    with pytest.raises(ArrayError, match=rf"^{name}: frame 0, node 0 is .*e\+29, too large to be stored \(at most 1.8e\+19\)$"):
        Trajectory.from_numpy(**arrays, frame_dt=DT, materials="sand", params={"sand": 30.0})


def test_absurd_positions_in_a_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ImportFailure, match=r"no training trajectory can be used: train, 0.npz, frame 0: pos: frame 0, node 0 is .* too large"
    ):
        converted(tmp_path, "absurd", [1e30 * swinging()])


def test_jumps_are_named(tmp_path: Path) -> None:
    arrays = [swinging(seed) for seed in range(4)]
    arrays[1][6, 17] += 3.0
    arrays[3][300 % 12 :, 5] -= 1.0
    report = converted(tmp_path, "jumps", arrays)
    (what,) = report.warnings  # of the last trajectory all frames are displaced
    assert what.startswith("train, 1.npz, frame 6: node 17 moves by 4.2")
    assert f"farther than the connectivity radius {report.connectivity_radius:.4g} m" in what
    assert "Warnings:\n  - train, 1.npz, frame 6: node 17 moves by" in report.text()


def test_jumps_late_in_long_trajectories_are_found() -> None:
    pos = swinging(num_frames=600)
    pos[520:, 3] += 1.0
    trajectory = Trajectory.from_numpy(pos, DT, "sand", {"sand": 30.0})
    motion = motion_of(trajectory.metadata, trajectory.pos)
    assert (motion.frame, motion.node) == (520, 3)
    assert motion.step == pytest.approx(np.sqrt(2), rel=1e-2)


def test_crossing_the_seam_is_no_jump(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    pos = [(sources.motion(seed=k) + 0.05 * np.arange(10)[:, None, None]) % 1.0 for k in range(3)]
    sources.lagrangebench_h5(tmp_path / "raw" / "train.h5", [(p, np.zeros(20, int)) for p in pos])
    report = import_dataset(tmp_path, ImportSettings("lagrangebench", str(tmp_path / "raw"), "set"))
    assert not any("moves by" in w for w in report.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("step", [1e-3, 1 / 640], ids=["three decimals", "pixels"])
def test_positions_with_few_digits_are_named(tmp_path: Path, step: float, precision: type) -> None:
    """Positions from text files or videos may be rounded before they are stored. This rounding, too, looks like acceleration."""
    error = step / (np.sqrt(2) * DT**2)
    true = [motion_of(Trajectory.from_numpy(swinging(seed), DT, "sand", {"sand": 30.0}).metadata, swinging(seed)) for seed in range(4)]
    assert error > 0.2 * true[0].acceleration
    assert not any(motion.marks.any() for motion in true)
    report = converted(tmp_path, "coarse", [(step * np.round(swinging(seed) / step)).astype(precision) for seed in range(4)])
    what = rf"positions in steps of {step:.3g} m round accelerations by {error:.3g} m/s², those of the data are .* rms: write them with more digits"
    assert len([w for w in report.warnings if re.search(what, w)]) == 4
    (group, *_) = validate([Path(report.folder) / "train"]).groups.values()
    assert f"positions in steps of {step:.3g} m round accelerations by" in str(group)


def test_motion_of_few_values_lies_on_no_marks() -> None:
    """Free fall beside nodes at rest, layers that slide over each other, and a lattice that is shaken."""
    lattice, time = swinging()[0], DT * np.arange(30)[:, None, None]
    falls = lattice - np.array([0.0, 4.9]) * time**2 * (np.arange(len(lattice)) % 2)[:, None]
    shear = lattice + np.stack([lattice[:, 1], 0 * lattice[:, 1]], axis=1) * time
    shaken = lattice + 0.02 * np.sin(8 * time)
    for pos in (falls, shear, shaken):
        for precision in (np.float32, np.float64):
            moved = pos.astype(precision)
            assert not motion_of(Trajectory.from_numpy(moved, DT, "sand", {"sand": 30.0}).metadata, moved).marks.any()


def test_neighbours_of_a_moving_boundary_are_counted_where_it_is() -> None:
    path = np.array([[[2.0, 0.0]], [[1.0, 0.0]], [[0.1, 0.0]]])  # comes to the first node
    pos = np.array([[[0.0, 0.0], [0.5, 0.0]]] * 3)
    boundary = Boundary.moving(path, [[-1.0, 0.0]], DT)
    trajectory = Trajectory.from_numpy(pos, DT, "sand", {"sand": 30.0}, connectivity_radius=0.2, boundary=boundary)
    assert [touching.tolist() for _, touching in degrees_of(trajectory)] == [[0, 0], [0, 0], [1, 0]]


def test_still_walls_keep_their_precision_beside_a_moving_one() -> None:
    far = np.array([500000.3, 4649776.2])
    floor = Boundary.from_numpy(far + SPACING * np.array([[0, 0], [1, 0], [2, 0]]), [[0, 1]] * 3)
    lid = Boundary.moving(far + 1 + SPACING * np.arange(4)[:, None, None] * np.ones((1, 2, 2)), [[0, -1]] * 2, DT)
    both = joined(2, floor, lid)
    assert both.motion is not None
    np.testing.assert_array_equal(both.motion.pos[:, :3], np.broadcast_to(floor.pos, (4, 3, 2)))
