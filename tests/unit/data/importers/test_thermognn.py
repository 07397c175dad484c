"""The beam of ThermodynamicsGNN becomes trajectories with clamps, forces, stress and hexahedra; other files are refused and run no code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import Data

from gpe_pl.data.importers import ImportFailure, ImportSettings, import_dataset
from gpe_pl.data.importers.report import Report
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Trajectory

DT, FRAMES = 1 / 20, 4
LATTICE = np.argwhere(np.ones((3, 2, 2)))
REST = 2.0 * np.random.default_rng(0).permutation(LATTICE)
"""Two cubes side by side; nodes are in any order."""
CLAMPED = REST[:, 0] == 0
SIDES = np.array([[a, b] for a in range(12) for b in range(12) if np.abs(REST[a] - REST[b]).sum() == 2]).T


def write(path: Path, load: float, **changes: Any) -> np.ndarray:
    """Write a beam in the layout of the source, and return its states [frame, node, 12]."""
    time = DT * np.arange(FRAMES)[:, None, None]
    vel = load * np.where(CLAMPED, 0.0, REST[:, 0])[None, :, None] * np.array([0.0, 1.0, 0.0]) * (1 + time)
    pos = REST + load * np.where(CLAMPED, 0.0, REST[:, 0])[None, :, None] * np.array([0.0, 1.0, 0.0]) * (time + time**2 / 2)
    stress = load * time * np.arange(1.0, 7.0) * np.ones((FRAMES, 12, 1))
    states = np.concatenate([pos, vel, stress], axis=2).astype(np.float32)
    force = np.where(REST[:, :1] == 4, [0.0, load, 0.0], 0.0).astype(np.float32)
    kind = np.stack([~CLAMPED, CLAMPED], axis=1).astype(np.float32)
    graphs = []
    for k in range(FRAMES - 1):
        values = {"x": states[k], "y": states[k + 1], "f": (k + 1) * force, "n": kind, "edge_index": SIDES} | changes
        graphs.append(Data(**{name: torch.from_numpy(np.array(value)) for name, value in values.items()}))
    torch.save(graphs, path)
    return states


def imported(folder: Path, **settings: Any) -> tuple[Report, list[Trajectory]]:
    report = import_dataset(folder / "data", ImportSettings("thermognn", str(folder), name="beam", **settings))
    return report, list(iter_trajectories(folder / "data" / "beam" / "imported", "train"))


def test_states_forces_and_clamps(tmp_path: Path) -> None:
    states = [write(tmp_path / f"beam_{k}.pt", 0.1 * k) for k in (1, 2)]
    _, (trajectory, _) = imported(tmp_path, splits={"train": [0, 1]})
    assert trajectory.force is not None and trajectory.stress is not None
    load = float(trajectory.force.max())
    own = states[round(load / 0.3) - 1]
    assert trajectory.metadata.frame_dt == DT
    assert trajectory.num_frames == FRAMES + 1
    np.testing.assert_allclose(trajectory.pos[1:] - trajectory.pos[1, :1], own[..., :3] - own[0, :1, :3], atol=1e-5)
    np.testing.assert_allclose((trajectory.pos[1] - trajectory.pos[0]) / DT, own[0, :, 3:6], atol=1e-4)
    np.testing.assert_array_equal(trajectory.vel[1:], own[..., 3:6])
    np.testing.assert_array_equal(trajectory.prescribed, np.repeat(CLAMPED[:, None], 3, axis=1))
    np.testing.assert_allclose(
        trajectory.force[1:4, REST[:, 0] == 4, 1], load / 3 * np.array([[1.0], [2.0], [3.0]]) * np.ones(4), rtol=1e-6
    )
    assert not trajectory.force[:, REST[:, 0] < 4].any()
    np.testing.assert_array_equal(trajectory.stress.node[2], own[1][:, [6, 9, 10, 7, 11, 8]])
    assert trajectory.metadata.with_stress == ("elastomer",)


def test_boxes_along_the_edges_become_hexahedra(tmp_path: Path) -> None:
    write(tmp_path / "beam_1.pt", 0.1)
    _, (trajectory,) = imported(tmp_path)
    assert trajectory.cells is not None and trajectory.cells.shape == (2, 8) and trajectory.rest_pos is not None
    corners = trajectory.rest_pos[trajectory.cells]
    across = corners[:, [1, 3, 4]] - corners[:, :1]
    np.testing.assert_allclose(np.linalg.det(across), 8.0)  # a right-handed cube with the edge 2
    np.testing.assert_allclose(corners[:, 6] - corners[:, 0], 2.0)


@pytest.mark.slow
def test_the_split_is_the_published_one(tmp_path: Path) -> None:
    for k in range(1, 21):
        write(tmp_path / f"beam_{k}.pt", 0.1 * k)
    report, _ = imported(tmp_path)
    assert [report.splits[split].trajectories for split in ("train", "val", "test")] == [16, 2, 2]
    order = [(k,) for k in range(20)]  # as the source shuffles it
    np.random.seed(1)  # noqa: NPY002
    np.random.shuffle(order)  # noqa: NPY002
    stored = [
        round(float(np.max(t.force)) / 0.3) - 1  # type: ignore[arg-type]
        for split in ("train", "val", "test")
        for t in iter_trajectories(tmp_path / "data" / "beam" / "imported", split)
    ]
    assert stored == [k for (k,) in order]


def test_a_missing_beam_would_shift_the_published_split(tmp_path: Path) -> None:
    for k in (1, 2, 3, 5, 8):
        write(tmp_path / f"beam_{k}.pt", 0.1 * k)
    with pytest.raises(ImportFailure, match=r"lacks beam_4.pt, beam_6.pt, beam_7.pt; the published split needs all files up to beam_8.pt"):
        imported(tmp_path)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"x": np.zeros((12, 11), np.float32)}, r"x is \[12, 11\], expected \[12, 12\]"),
        ({"f": np.zeros((11, 3), np.float32)}, r"f is \[11, 3\], expected \[12, 3\]"),
        ({"y": np.ones((12, 12), np.float32)}, "does not begin where the step before ended"),
        ({"edge_index": np.array([[0], [12]])}, "names a node that is not among the 12 nodes"),
        ({"edge_index": np.array([[0], [1]])}, "enclose no hexahedron"),
    ],
)
def test_a_beam_that_does_not_fit_is_refused(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    write(tmp_path / "beam_1.pt", 0.1, **changes)
    with pytest.raises(ImportFailure, match=says):
        imported(tmp_path)


def test_nodes_without_a_lattice_are_refused(tmp_path: Path) -> None:
    states = write(tmp_path / "beam_1.pt", 0.1)
    states[..., :3] += np.random.default_rng(0).uniform(0, 0.3, (12, 3))
    graphs = [
        Data(
            x=torch.from_numpy(states[k]),
            y=torch.from_numpy(states[k + 1]),
            f=torch.zeros(12, 3),
            n=torch.zeros(12, 2),
            edge_index=torch.from_numpy(SIDES),
        )
        for k in range(FRAMES - 1)
    ]
    torch.save(graphs, tmp_path / "beam_1.pt")
    with pytest.raises(ImportFailure, match="do not form a lattice"):
        imported(tmp_path)


class Dangerous:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.mark,)


def test_no_code_of_a_file_is_run(tmp_path: Path) -> None:
    torch.save([Dangerous(tmp_path / "mark")], tmp_path / "beam_1.pt")
    with pytest.raises(ImportFailure, match="more than tensors"):
        imported(tmp_path)
    assert not (tmp_path / "mark").exists()


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04" + bytes(40)])
def test_a_damaged_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "beam_1.pt").write_bytes(content)
    with pytest.raises(ImportFailure, match=r"beam_1\.pt"):
        imported(tmp_path)


def test_an_array_larger_than_its_file_is_refused(tmp_path: Path) -> None:
    states = torch.zeros(1).as_strided((10**9, 12), (0, 0))
    torch.save([Data(x=states, y=states, f=states, n=states, edge_index=states)], tmp_path / "beam_1.pt")
    with pytest.raises(ImportFailure, match="at most|fewer values"):
        imported(tmp_path)


def test_a_folder_without_beams_is_named(tmp_path: Path) -> None:
    with pytest.raises(ImportFailure, match=r"holds no beam_1\.pt"):
        imported(tmp_path)
