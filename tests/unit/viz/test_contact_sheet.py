from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from gpe_pl.schema import node_code
from gpe_pl.trajectory.trajectory import Termination
from gpe_pl.viz.coloring import ColorBy
from gpe_pl.viz.contact_sheet import contact_sheet
from gpe_pl.viz.figures import parameter_strip, rollout_figure
from tests.open_scenes import open_trajectory
from tests.unit.viz.conftest import falling


def texts(figure) -> list[str]:
    return [t.get_text() for t in figure.texts]


def with_fewer_nodes(trajectory):
    keep = slice(0, trajectory.num_nodes // 2)
    parts = {name: getattr(trajectory, name)[keep] for name in ("node_type", "mass", "material_params")}
    return replace(trajectory, pos=trajectory.pos[:, keep], vel=trajectory.vel[:, keep], **parts)


def test_nodes_that_are_not_in_an_open_scene_are_not_drawn(tmp_path):
    scene = open_trajectory()
    assert scene.alive is not None
    there = scene.alive.sum(axis=1)
    figure = contact_sheet({"channel": scene}, num_columns=3)
    frames = [0, (scene.num_frames - 1) // 2, scene.num_frames - 1]
    shown = [len(axes.collections[0].get_offsets()) for axes in figure.axes]
    assert shown == [there[frame] for frame in frames] and len(set(shown)) > 1
    (row, _) = parameter_strip([("30°", scene, scene)], num_columns=3).axes[::3]
    assert len(row.collections[0].get_offsets()) == there[0]


@pytest.mark.slow
def test_a_row_per_trajectory_and_a_column_per_time(ground_truth, dim):
    rows = {f"friction angle\n{angle} deg": ground_truth for angle in (20, 30)} | {"half": with_fewer_nodes(ground_truth)}
    figure = contact_sheet(rows, num_columns=4)
    assert len(figure.axes) == 3 * 4
    shown = [len(axes.collections[0].get_offsets()) for axes in figure.axes]
    assert shown == [ground_truth.num_nodes] * 8 + [ground_truth.num_nodes // 2] * 4
    assert "friction angle\n20 deg" in texts(figure) and "half" in texts(figure)
    assert {"$t$ = 0.00 s", "0.22 s"} <= set(texts(figure))
    assert len(contact_sheet({"a": ground_truth}).axes) == 6


def test_rows_that_are_low_break_their_labels(ground_truth, dim):
    if dim == 3:
        pytest.skip("the same")
    flat = replace(ground_truth, metadata=replace(ground_truth.metadata, bounds=((0.0, 1.0), (0.0, 0.4))))
    figure = contact_sheet({"hardening coefficient\n10": flat})
    assert "hardening\ncoefficient\n10" in texts(figure)
    label = next(t for t in figure.texts if t.get_text().startswith("hardening"))
    box, first = label.get_window_extent(), figure.axes[0].get_window_extent()
    assert box.x0 >= 0 and box.x1 <= first.x0


FLAT = ((0.0, 3.0), (0.0, 0.3))


def flat_figure(rows: list[str], color: ColorBy = "error"):
    """Return a figure of a channel of 3 m × 0.3 m whose last row has nodes above it and nodes without a position, and with a row that stopped."""
    base = falling(2)
    base = replace(base, metadata=replace(base.metadata, bounds=FLAT), vel=np.ones_like(base.pos))
    truth = replace(base, pos=0.3 * base.pos)
    pos = truth.pos.copy()
    pos[5:, :5, 1], pos[5:, 5:7] = 1.0, np.nan
    short = replace(truth.frames(0, 5), termination=Termination("explosion", 5, 0, ""))
    figure = rollout_figure(truth, dict.fromkeys(rows, short) | {"last": replace(truth, pos=pos)}, color=color)
    figure.canvas.draw()
    return figure


def are_apart(boxes) -> bool:
    return all(a.x1 <= b.x0 or b.x1 <= a.x0 or a.y1 <= b.y0 or b.y1 <= a.y0 for a, b in combinations(boxes, 2))


@pytest.mark.slow
@pytest.mark.parametrize("rows", [[], ["second"], ["one", "two", "a longer name"]])
def test_labels_and_notes_of_flat_scenes_have_room(rows):
    figure = flat_figure(rows)
    labels = [text.get_window_extent() for text in figure.texts if text.get_rotation() == 90]
    notes = [axes.texts[0].get_window_extent() for axes in figure.axes[:-1] if axes.texts[0].get_text()]
    assert len(labels) == len(rows) + 2 and len(notes) == 3 * len(rows) + 3
    assert are_apart([*labels, *notes, *(text.get_window_extent() for text in figure.texts if text.get_rotation() == 0)])
    assert all(figure.bbox.x0 <= box.x0 and box.y1 <= figure.bbox.y1 and box.y0 >= figure.bbox.y0 for box in labels)
    for axes in figure.axes[-7:-1]:  # notes about nodes do not hide a low panel
        note = axes.texts[0].get_window_extent()
        assert not axes.texts[0].get_text() or note.y0 >= axes.bbox.y1 - 1


@pytest.mark.slow
@pytest.mark.parametrize("is_prediction", [False, True])
def test_the_colour_bar_of_a_flat_scene_can_be_read(is_prediction):
    flat = falling(2)
    flat = replace(flat, metadata=replace(flat.metadata, bounds=FLAT), vel=np.ones_like(flat.pos), is_prediction=is_prediction)
    for figure in (rollout_figure(flat, {"GPE": flat}), rollout_figure(flat, {}, color="speed")):
        figure.canvas.draw()
        bar = figure.axes[-1]
        assert bar.bbox.height > 0.75 * figure.dpi  # without its tip
        ticks = [t.get_window_extent() for t in bar.get_yticklabels() if bar.get_ylim()[0] <= t.get_position()[1] <= bar.get_ylim()[1]]
        assert len(ticks) > 1 and are_apart(ticks)
        label, whole = bar.yaxis.label.get_window_extent(), figure.bbox
        assert whole.y0 <= label.y0 and label.y1 <= whole.y1 and label.x1 <= whole.x1


@pytest.mark.slow
def test_notes_stay_within_their_panel(ground_truth):
    pos = ground_truth.pos.copy()
    pos[5:, :5, -1], pos[5:, 5:7] = 3.0, np.nan
    figure = rollout_figure(ground_truth, {"GPE": replace(ground_truth, pos=pos)})
    figure.canvas.draw()
    for axes in figure.axes[:-1]:
        note, panel = axes.texts[0].get_window_extent(), axes.bbox
        assert not axes.texts[0].get_text() or (panel.x0 <= note.x0 and note.x1 <= panel.x1 and panel.y0 <= note.y0 and note.y1 <= panel.y1)
    assert sum(bool(axes.texts[0].get_text()) for axes in figure.axes[:-1]) == 3


@pytest.mark.slow
def test_stress_has_a_colour_bar_in_engineering_units(mesh):
    figure = contact_sheet({"0.5 MPa": mesh, "1 MPa": mesh}, num_columns=3)
    assert len(figure.axes) == 2 * 3 + 1
    bar = figure.axes[-1]
    assert bar.get_ylabel() == "von Mises stress"
    figure.canvas.draw()
    labels = [t.get_text() for t in bar.get_yticklabels()]
    assert labels[0] == "0 Pa" and any(label.endswith(" kPa") for label in labels)
    panels = figure.axes[:6]
    assert bar.get_position().x0 > max(axes.get_position().x1 for axes in panels)
    assert bar.get_position().y0 == pytest.approx(panels[-1].get_position().y0)
    for part in (bar.yaxis.label, *bar.get_yticklabels()):
        assert part.get_window_extent().x1 <= figure.bbox.x1


def test_several_materials_have_a_legend(ground_truth):
    types = ground_truth.node_type.copy()
    types[::2] = node_code("elastomer")
    mixed = replace(ground_truth, node_type=types, metadata=replace(ground_truth.metadata, materials=("sand", "elastomer", "snow")))
    figure = contact_sheet({"a": mixed}, num_columns=2)
    (legend,) = figure.legends
    assert [t.get_text() for t in legend.get_texts()] == ["sand", "elastomer"]  # snow does not occur
    assert legend.get_window_extent().y1 <= figure.axes[-1].get_window_extent().y0
    assert not contact_sheet({"a": ground_truth}, 2).legends


def test_a_row_that_stopped_says_so(ground_truth):
    short = replace(ground_truth.frames(0, 5), termination=Termination("nan", 5, 0, "frame 5: no number"))
    figure = contact_sheet({"whole": ground_truth, "short": short, "cut": ground_truth.frames(0, 5)}, num_columns=2)
    assert [axes.texts[0].get_text() for axes in figure.axes] == ["", "", "", "stopped at 0.10 s\n(nan)", "", "not simulated"]


@pytest.mark.slow
def test_short_times_are_told_apart(ground_truth):
    quick = replace(ground_truth, metadata=replace(ground_truth.metadata, frame_dt=1e-3))
    assert texts(contact_sheet({"a": quick}, num_columns=12))[1:4] == ["$t$ = 0.000 s", "0.001 s", "0.002 s"]
    assert texts(contact_sheet({"a": quick}, num_columns=3))[1:4] == ["$t$ = 0.000 s", "0.006 s", "0.011 s"]  # not rounded


def test_a_sheet_is_saved_at_its_own_resolution(tmp_path, ground_truth):
    from PIL import Image

    contact_sheet({"a": ground_truth}, 2).savefig(tmp_path / "sheet.png")
    with Image.open(tmp_path / "sheet.png") as image:
        assert image.width == 7 * 220


def test_empty_sheets_are_refused(ground_truth):
    with pytest.raises(ValueError, match="at least one"):
        contact_sheet({})
    with pytest.raises(ValueError, match="num_columns"):
        contact_sheet({"a": ground_truth}, num_columns=0)
