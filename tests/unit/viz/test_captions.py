"""Pictures state whether they show ground truth or a prediction, and the material and its parameter."""

import html
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from gpe_pl.data.importers import draw_contact_sheet, save_dataset
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import MATERIALS, node_code
from gpe_pl.trajectory.store import read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Termination, Trajectory
from gpe_pl.viz import contact_sheet as sheets
from gpe_pl.viz import video
from gpe_pl.viz.camera import Camera
from gpe_pl.viz.captions import as_written, describe, frame_time, hidden_nodes, parameter_value, row_label
from gpe_pl.viz.contact_sheet import contact_sheet
from gpe_pl.viz.figures import rollout_figure
from gpe_pl.viz.video import write_animation, write_film
from gpe_pl.viz.viewer import write_viewer
from tests.contracts.test_solvers import flip
from tests.scenes import metadata
from tests.unit.viz.conftest import falling

SAND = "sand, friction angle 27.5°"


def truth(angle: float = 27.5) -> Trajectory:
    trajectory = falling(2)
    return replace(trajectory, material_params=np.full_like(trajectory.material_params, angle))


def predicted() -> Trajectory:
    t = truth()
    return rollout(Ballistic(t.metadata.frame_dt), t.state(0), 6, t.metadata)


def mixed() -> Trajectory:
    """Return a scene that is half sand, half an elastomer of varying stiffness."""
    t = truth()
    types, params = t.node_type.copy(), np.full((t.num_nodes, 2), np.nan, np.float32)
    types[::2] = node_code("elastomer")
    params[1::2, 0], params[::2, 1] = 27.5, np.linspace(6e5, 1e6, len(params[::2]))
    about = replace(t.metadata, materials=("sand", "elastomer"), param_names=("friction_angle", "youngs_modulus"))
    return replace(t, node_type=types, material_params=params, metadata=about)


def texts(figure: Figure) -> list[str]:
    return [t.get_text().replace("\n", " ") for t in figure.texts]


def page(path: Path) -> tuple[str, str, list[str]]:
    """Return title and heading of a viewer, and the names of its trajectories."""
    text = path.read_text(encoding="utf-8")
    title, heading = (html.unescape(re.sub("<[^>]*>", "", re.findall(f"<{tag}>(.*?)</{tag}>", text)[0])) for tag in ("title", "h1"))
    scene = json.loads(re.findall(r'id="scene">(.*?)</script>', text)[0])
    return title, heading, [trajectory["name"] for trajectory in scene["trajectories"]]


def test_a_rollout_knows_whether_a_solver_made_it() -> None:
    assert predicted().is_prediction and predicted().frames(2).is_prediction
    assert not truth().is_prediction
    solver, state = flip(2)
    assert not rollout(solver, state, 1, metadata(("fluid",), 2)).is_prediction


def test_a_prediction_alone_is_called_so(tmp_path: Path) -> None:
    figure = rollout_figure(predicted(), {})
    assert {"prediction", SAND} <= set(texts(figure)) and "ground truth" not in texts(figure)
    write_viewer(tmp_path / "a.html", predicted())
    assert page(tmp_path / "a.html") == ("test: prediction", f"test {SAND}", ["prediction"])
    for name, value in (("ground truth", truth()), ("prediction", predicted())):
        with pytest.raises(ValueError, match=f"'{name}' is the name of the first trajectory"):
            rollout_figure(value, {name: predicted()})


def test_ground_truth_is_called_so(tmp_path: Path) -> None:
    assert {"ground truth", "GPE", SAND} <= set(texts(rollout_figure(truth(), {"GPE": predicted()})))
    write_viewer(tmp_path / "a.html", truth(), {"GPE": predicted()}, title="A <test>")
    assert page(tmp_path / "a.html") == ("A <test>: ground truth, GPE", f"A <test> {SAND}", ["ground truth", "GPE"])


@pytest.mark.slow
def test_films_say_what_they_show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, None] = {}  # a GIF is drawn twice, first for its palette

    class Watched(video.Figure):  # type: ignore[misc, name-defined]
        def text(self, x: float, y: float, s: str, **style: object) -> object:
            drawn[s] = None
            return super().text(x, y, s, **style)

    monkeypatch.setattr(video, "Figure", Watched)
    write_animation(tmp_path / "a.gif", predicted(), {}, stride=6)
    assert [*drawn] == ["prediction", SAND, "colour: height at the start", ""]  # the last becomes the time
    drawn.clear()
    write_film(tmp_path / "b.gif", "GPE", predicted())
    assert [*drawn] == ["GPE", f"{SAND}; colour: height at the start", ""]


@pytest.mark.slow
def test_contact_sheets_name_values_where_they_differ(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "sand, friction angle 27.5°; colour: height at the start" in texts(contact_sheet({"a": truth(), "b": truth()}))
    assert "sand; colour: height at the start" in texts(contact_sheet({"20°": truth(20.0), "30°": truth(30.0)}))
    labels: list[str] = []

    def watched(rows: dict[str, Trajectory]) -> Figure:
        labels.extend(rows)
        return contact_sheet(rows)

    monkeypatch.setattr(sheets, "contact_sheet", watched)
    for name, angles in (("same", (20.0, 20.0)), ("other", (20.0, 30.0))):
        shown = [replace(truth(angle), pos=truth().pos + 0.001 * k) for k, angle in enumerate(angles)]
        draw_contact_sheet(save_dataset(tmp_path, name, holdout=0.0, train=shown))
    assert labels == ["train 0", "train 1", "train 0: sand, friction angle 20°", "train 1: sand, friction angle 30°"]


def test_several_materials_are_named_above_their_legend() -> None:
    figure = contact_sheet({"a": mixed()}, 2)
    (legend,) = figure.legends
    (caption,) = (t for t in figure.texts if t.get_text() == "sand, friction angle 27.5°; elastomer, Young’s modulus 0.6 … 1 MPa")
    figure.canvas.draw()
    assert legend.get_window_extent().y1 <= caption.get_window_extent().y0 + 1
    assert caption.get_window_extent().y1 <= figure.axes[-1].get_window_extent().y0


def test_values_have_their_unit() -> None:
    first = {material: own[0] for material, own in MATERIALS.items()}
    assert [parameter_value(first["solid"], x) for x in (2.1e11, 6e5, 500.0)] == ["210 GPa", "600 kPa", "500 Pa"]
    assert parameter_value(first["fluid"], 8.93e-7) == "8.93e-07 m²/s"
    assert (parameter_value(first["snow"], 8.0), parameter_value(first["sand"], 20.0, 30.0)) == ("8", "20 … 30°")
    assert row_label({"sand": 20.0}) == "friction angle\n20°" and row_label({"sand": 20.0, "snow": 8.0}) == "sand 20°\nsnow 8"
    named = {"elastomer": {"youngs_modulus": 1e5, "poisson_ratio": 0.3}}
    assert row_label(named) == "Young’s modulus\n100 kPa\nPoisson’s ratio\n0.3"
    assert row_label({**named, "sand": 20.0}) == "elastomer 100 kPa, 0.3\nsand 20°"
    assert describe(replace(truth(), material_params=np.full((truth().num_nodes, 1), np.nan))) == "sand"


def test_a_stored_prediction_stays_one(tmp_path: Path) -> None:
    write_shard(tmp_path / "a.h5", [truth(), predicted()])
    assert [read_trajectory(tmp_path / "a.h5", name).is_prediction for name in ("00000", "00001")] == [False, True]


def test_trajectories_that_begin_at_other_times_are_not_shown_together(tmp_path: Path) -> None:
    late = predicted().frames(1)
    for show in (
        lambda: rollout_figure(truth(), {"other": late}),
        lambda: write_animation(tmp_path / "a.gif", truth(), {"other": late}),
        lambda: write_viewer(tmp_path / "a.html", truth(), {"other": late}),
    ):
        with pytest.raises(ValueError, match=r"'other' begins at 0.\d+ s and the ground truth at 0 s; cut one of them"):
            show()
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_a_distance_between_predictions_is_no_error() -> None:
    bars = [rollout_figure(first, {"other": predicted()}, color="error").axes[-1].get_ylabel() for first in (truth(), predicted())]
    assert [" ".join(label.split("\n")) for label in bars] == ["position error [m]", "distance from the first rollout [m]"]


@pytest.mark.parametrize(
    ("frame", "frame_dt", "expected"),
    [
        (48, 0.002, "0.096 s"),
        (7, 2.5e-3, "0.0175 s"),
        (7, float(np.float32(2.5e-3)), "0.0175 s"),  # as stored
        (11, 0.02, "0.22 s"),
        (5, 0.1, "0.5 s"),
        (3, 40.0, "120 s"),
        (59, 1 / 60, "0.9833 s"),
    ],
)
def test_times_are_as_exact_as_the_time_between_frames(frame, frame_dt, expected):
    t = truth()
    assert frame_time(frame, replace(t, metadata=replace(t.metadata, frame_dt=frame_dt))) == expected


def test_times_count_from_the_start_of_the_scene(tmp_path: Path) -> None:
    t, p = truth(), predicted()
    pairs = (t, p), (t.frames(3), p.frames(3))
    whole, cut = ([text for text in texts(rollout_figure(own, {"m": other})) if text.endswith(" s")] for own, other in pairs)
    dt = t.metadata.frame_dt
    assert whole[0] == f"$t$ = {frame_time(0, t)}" and whole[-1] == cut[-1]
    assert cut[0] == f"$t$ = {frame_time(3, t)}"
    stopped = replace(p.frames(3, 5), termination=Termination("explosion", 2, 0, "x"))
    write_viewer(tmp_path / "a.html", t.frames(3), {"m": stopped})
    scene = json.loads(re.search(r'id="scene"[^>]*>(.*?)</script>', (tmp_path / "a.html").read_text(encoding="utf-8"), re.S)[1])  # type: ignore[index]
    assert scene["startTime"] == pytest.approx(3 * dt)
    assert scene["trajectories"][1]["stopped"] == f"stopped at {frame_time(5, t)} (explosion)"


@pytest.mark.parametrize(("place", "is_told"), [(1.0 + 0.4, False), (1.0 + 0.7, True), (-0.7, True)])
def test_a_picture_tells_which_nodes_it_does_not_show(place: float, is_told: bool) -> None:
    """``place`` counts spacings from the lower end, or beyond the upper one."""
    t = truth()
    (low, high), spacing = t.metadata.bounds[0], t.metadata.spacing
    pos = t.pos.copy()
    pos[0, 0, 0] = high + (place - 1) * spacing if place > 0 else low + place * spacing
    moved = replace(t, pos=pos)
    camera = Camera(moved)
    assert (camera.low[0] <= pos[0, 0, 0] <= camera.high[0]) != is_told
    assert hidden_nodes(moved, 0) == ([f"1 of {t.num_nodes} nodes are outside"] if is_told else [])


@pytest.mark.parametrize("text", ["$a_b$ <x> & $y$", "_test", "a $ b", "plain"])
def test_names_are_shown_as_written(text: str) -> None:
    figure = Figure()
    axes = figure.subplots()
    axes.plot([1, 2], label=as_written(text))
    (shown,) = axes.legend().get_texts()
    clean, is_mathematics = shown._preprocess_math(shown.get_text())  # type: ignore[attr-defined]
    assert clean.removeprefix("\u200b") == text and not is_mathematics
