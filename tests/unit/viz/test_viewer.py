import base64
import json
import re
import zlib
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from gpe_pl.export.trajectories import write_vtk
from gpe_pl.trajectory.state import Stress
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.viewer import FASTEST, ViewerError, write_viewer
from tests.open_scenes import open_trajectory


class Page:
    """Content of a written page, read as its script reads it."""

    def __init__(self, path) -> None:
        self.text = path.read_text()
        found = re.search(r'<script type="application/json" id="scene">(.*?)</script>', self.text, re.S)
        assert found
        self.scene = json.loads(found[1])
        self.arrays = {}
        for name, kind, width, text in re.findall(r'data-name="(\w+)" data-kind="(\w+)" data-width="(\d+)">(.*?)<', self.text):
            data = zlib.decompress(base64.b64decode(text))
            if kind == "frames":
                low, high = np.frombuffer(data, np.uint8).reshape(2, -1).astype(np.uint16)
                self.arrays[name] = np.cumsum((low | high << 8).reshape(-1, int(width)), axis=0, dtype=np.uint16)
            else:
                self.arrays[name] = np.frombuffer(data, kind)

    def positions(self, number: int) -> np.ndarray:
        """Return positions [frame, node, dim] in m; NaN where a node is not shown."""
        dim = self.scene["dim"]
        level = self.arrays[f"t{number}_pos"].reshape(-1, self.scene["nodes"], dim).astype(float)
        low, extent = (np.array(self.scene["position"][key][:dim]) for key in ("low", "extent"))
        return np.where(level == 65535, np.nan, low + level / 65535 * extent)


def test_positions_come_back_within_the_rounding_that_is_told(tmp_path, ground_truth, prediction):
    rounding = write_viewer(tmp_path / "a.html", ground_truth, {"GPE": prediction})
    page = Page(tmp_path / "a.html")
    for number, trajectory in enumerate((ground_truth, prediction)):
        difference = np.abs(page.positions(number) - trajectory.pos).max()
        assert 0 < difference <= rounding * (1 + 1e-9)
    assert rounding == page.scene["rounding"] < 1e-5
    assert [p.name for p in tmp_path.iterdir()] == ["a.html"]


def test_quantities_come_back_and_say_where_there_is_none(tmp_path, mesh):
    vel = np.random.default_rng(0).normal(size=mesh.pos.shape)
    write_viewer(tmp_path / "a.html", replace(mesh, vel=vel))
    page = Page(tmp_path / "a.html")
    steps = page.scene["steps"]
    np.testing.assert_allclose(page.arrays["t0_speed"] * steps["speed"], np.linalg.norm(vel, axis=-1), atol=steps["speed"])
    stress = page.arrays["t0_von_mises"]
    in_mesh = np.isin(np.arange(mesh.num_nodes), mesh.cells)
    assert (stress[:, ~in_mesh] == 65535).all() and not in_mesh.all()
    np.testing.assert_allclose(stress[:, in_mesh] * steps["von_mises"], mesh.stress.node_von_mises[:, in_mesh], atol=steps["von_mises"])
    assert page.scene["colors"][0]["by"] == "von_mises"


def test_a_scale_says_whether_values_exceed_it(tmp_path, mesh):
    node = np.zeros_like(mesh.stress.node)
    node[:, mesh.cells[0, 0], 0] = 8e5  # of one node, so the mean of each cell is lower
    vel = np.ones_like(mesh.vel)
    write_viewer(tmp_path / "a.html", replace(mesh, vel=vel, stress=Stress(node, mesh.stress.cell)))
    colors = {color["by"]: color for color in Page(tmp_path / "a.html").scene["colors"]}
    assert colors["von_mises"]["isExceeded"] == (colors["von_mises"]["high"] < 8e5)
    assert colors["von_mises"]["high"] > 2e5
    assert not any(colors[by]["isExceeded"] for by in ("speed", "height", "material"))
    vel[3, 0] = 50.0
    write_viewer(tmp_path / "a.html", replace(mesh, vel=vel))
    (speed,) = (color for color in Page(tmp_path / "a.html").scene["colors"] if color["by"] == "speed")
    assert speed["isExceeded"] and speed["high"] < 50


def test_what_exploded_is_left_out_and_takes_no_precision(tmp_path, ground_truth):
    pos, vel = ground_truth.pos.copy(), ground_truth.vel.copy()
    vel[...] = 1.0
    pos[5, 0], pos[6, 1], vel[5, 0] = np.nan, 1e9, 1e12
    wild = replace(ground_truth, pos=pos, vel=vel)
    rounding = write_viewer(tmp_path / "a.html", ground_truth, {"wild": wild})
    page = Page(tmp_path / "a.html")
    shown = page.positions(1)
    missing = np.isnan(shown).all(axis=-1)
    assert missing[5, 0] and missing[6, 1] and missing.sum() == 2
    assert rounding < 1e-5 and page.scene["steps"]["speed"] <= FASTEST * vel.shape[-1] / 65534
    assert page.scene["cut"] == ["speed"]
    write_viewer(tmp_path / "b.html", ground_truth)
    assert Page(tmp_path / "b.html").scene["cut"] == []
    about, count = page.scene["trajectories"][1], ground_truth.num_nodes
    assert about["rmse"][4] == about["rmse"][5] == 0.0
    assert about["notes"][4:7] == ["", f"1 of {count} nodes are missing", f"1 of {count} nodes are outside"]
    assert not any(page.scene["trajectories"][0]["notes"])


def test_the_error_is_that_of_the_nodes_that_have_a_position(tmp_path, ground_truth, prediction):
    pos = prediction.pos.copy()
    pos[7:, ::2] = np.nan
    pos[9:] = np.nan
    write_viewer(tmp_path / "a.html", ground_truth, {"GPE": replace(prediction, pos=pos)})
    rmse = Page(tmp_path / "a.html").scene["trajectories"][1]["rmse"]
    assert rmse[7] == pytest.approx(np.sqrt(((pos[7, 1::2] - ground_truth.pos[7, 1::2]) ** 2).sum(-1).mean()))
    assert rmse[9:] == [None] * (len(pos) - 9)


def test_nodes_that_are_not_in_an_open_scene_are_not_missing(tmp_path):
    scene = open_trajectory()
    assert scene.alive is not None
    write_viewer(tmp_path / "a.html", scene, {"GPE": scene.frames(0, 10)})
    assert not any(any(trajectory["notes"]) for trajectory in Page(tmp_path / "a.html").scene["trajectories"])
    assert not scene.alive[9].all()


def test_error_curve_is_the_root_mean_square(tmp_path, ground_truth, stopped):
    write_viewer(tmp_path / "a.html", ground_truth, {"GPE": stopped}, stride=3)
    about = Page(tmp_path / "a.html").scene["trajectories"][1]
    expected = np.sqrt(((stopped.pos[[0, 3, 6]] - ground_truth.pos[[0, 3, 6]]) ** 2).sum(-1).mean(-1))
    assert about["rmse"][:3] == pytest.approx(expected) and about["rmse"][3] is None
    assert about["frames"] == 3 and about["stopped"] == "stopped at 0.14 s (explosion)"


def test_times_have_the_decimals_of_the_frames(tmp_path, ground_truth, stopped):
    quick, short = (replace(t, metadata=replace(t.metadata, frame_dt=2.5e-3)) for t in (ground_truth, stopped))
    for stride in (1, 4):
        write_viewer(tmp_path / "a.html", quick, {"GPE": short}, stride)
        scene = Page(tmp_path / "a.html").scene
        assert scene["decimals"] == 4 and scene["trajectories"][1]["stopped"] == "stopped at 0.0175 s (explosion)"


def test_names_cannot_break_out_of_the_page(tmp_path, ground_truth, prediction):
    write_viewer(tmp_path / "a.html", ground_truth, {"</script><b>": prediction}, title="<i>&")
    page = Page(tmp_path / "a.html")
    assert page.scene["trajectories"][1]["name"] == "</script><b>" and "<b>" not in page.text
    assert "<title>&lt;i&gt;&amp;: ground truth, " in page.text


def test_the_page_refers_to_nothing_outside_of_it(tmp_path, mesh):
    write_viewer(tmp_path / "a.html", mesh)
    text = re.sub(r'data-width="\d+">.*?<', "", (tmp_path / "a.html").read_text())
    assert not re.search(r"https?:|\bsrc=|<link|@import|\bimport\(", text)
    assert "default-src 'none'" in text


def test_surfaces_of_tetrahedra_and_quadrilaterals_become_triangles(tmp_path, mesh, dim):
    write_viewer(tmp_path / "a.html", mesh)
    page = Page(tmp_path / "a.html")
    triangles = page.arrays["triangles"].reshape(-1, 3)
    assert len(triangles) == (8 if dim == 2 else 48)
    assert set(page.arrays["loose"]) == {mesh.num_nodes - 2, mesh.num_nodes - 1}
    assert (len(page.arrays["outline"]) > 0) == (dim == 2)


def test_solids_are_where_their_distance_is_negative(tmp_path):
    from tests.unit.viz.conftest import falling

    write_viewer(tmp_path / "a.html", falling(2))
    page = Page(tmp_path / "a.html")
    solid = page.arrays["solid"].reshape(page.scene["solid"]["height"], page.scene["solid"]["width"])
    middle = solid.shape[0] // 5  # row at the height of the ball around (0.5, 0.2)
    assert solid[middle, solid.shape[1] // 2] < 128 < solid[middle, int(0.7 * solid.shape[1])]


def test_what_does_not_fit_is_refused(tmp_path, ground_truth: Trajectory, mesh):
    fewer = replace(ground_truth, node_type=ground_truth.node_type[:-1], pos=ground_truth.pos[:, :-1])
    with pytest.raises(
        ViewerError, match=rf"'GPE' has {fewer.num_nodes} nodes and the ground truth {ground_truth.num_nodes}, or their materials differ"
    ):
        write_viewer(tmp_path / "a.html", ground_truth, {"GPE": fewer})
    longer = ground_truth.every(2)
    with pytest.raises(ValueError, match=r"'GPE' has frames of .* s and the ground truth of .* s; take every so many frames of one"):
        write_viewer(tmp_path / "a.html", ground_truth, {"GPE": longer})
    with pytest.raises(ValueError, match=r"frames are .* s long, those of the ground truth"):
        write_vtk(tmp_path / "a.pvd", longer, ground_truth)
    with pytest.raises(ValueError, match=r"a viewer ends in \.html"):
        write_viewer(tmp_path / "a.htm", ground_truth)
    with pytest.raises(ValueError, match="stride must be positive"):
        write_viewer(tmp_path / "a.html", ground_truth, stride=0)
    assert not [*tmp_path.iterdir()]


def test_a_periodic_domain_shows_its_nodes_inside(tmp_path, mesh, dim):
    periodic = replace(mesh, metadata=replace(mesh.metadata, periodic=(True,) + (False,) * (dim - 1)), pos=mesh.pos + 0.6 * np.eye(dim)[0])
    write_viewer(tmp_path / "a.html", periodic)
    page = Page(tmp_path / "a.html")
    across = page.positions(0)[..., 0]
    assert page.scene["periods"] == [1.0] + [0.0] * (dim - 1) and periodic.pos[..., 0].max() > 1
    assert across.min() >= 0 and across.max() <= 1
    np.testing.assert_allclose(across, periodic.pos[..., 0] % 1, atol=1e-5)


def test_a_prediction_without_stress_has_none(tmp_path, mesh):
    write_viewer(tmp_path / "a.html", mesh, {"GNS": replace(mesh, stress=None)})
    fields = [t["fields"] for t in Page(tmp_path / "a.html").scene["trajectories"]]
    assert fields == [["pos", "speed", "von_mises"], ["pos", "speed"]]
    assert isinstance(mesh.stress, Stress)


def test_obstacles_that_are_nodes_only_are_drawn_beside_walls_with_shapes(tmp_path):
    from tests.unit.viz.conftest import falling

    trajectory = falling(2)
    assert trajectory.boundary.shapes
    boundary = trajectory.boundary
    ring = 0.5 + 0.1 * np.stack([np.cos(np.arange(12)), np.sin(np.arange(12))], axis=1)
    columns = {f.name: getattr(boundary, f.name) for f in fields(boundary) if isinstance(getattr(boundary, f.name), np.ndarray)}
    longer: dict[str, Any] = {k: np.concatenate([v, ring if k == "pos" else v[:1].repeat(12, axis=0)]) for k, v in columns.items()}
    more = replace(boundary, **longer)
    sizes = []
    for number, own in enumerate((boundary, more)):
        write_viewer(tmp_path / f"{number}.html", replace(trajectory, boundary=own))
        sizes.append(len(Page(tmp_path / f"{number}.html").arrays["lines"]))
    assert (sizes[1] - sizes[0]) % (4 * len(ring)) == 0
    assert sizes[1] > sizes[0]
