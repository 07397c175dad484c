"""The viewer in a browser: it plays, reacts to input, and makes no network request. Skipped without a browser."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import Stress
from gpe_pl.trajectory.trajectory import Termination, Trajectory
from gpe_pl.viz.coloring import MATERIAL_COLORS
from gpe_pl.viz.viewer import write_viewer
from tests.unit.viz.conftest import falling, falling_mesh


class Viewer:
    """An open page, and its errors."""

    def __init__(self, browser: Any, path: Path) -> None:
        self.page = browser.new_page(viewport={"width": 900, "height": 420})
        self.problems: list[str] = []
        self.requests: list[str] = []
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", lambda message: self.problems.append(message.text) if message.type in ("error", "warning") else None)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("#message", state="hidden", timeout=30_000)

    def picture(self) -> np.ndarray:
        """Return the panels as RGB [height, width, 3]."""
        with Image.open(BytesIO(self.page.locator("#stage").screenshot())) as image:
            return np.asarray(image.convert("RGB")).astype(int)

    def colored(self, panel: int) -> np.ndarray:
        """Return rows and columns of the coloured pixels of one of three panels, without its colour bar."""
        picture = self.picture()[:-40]
        width = picture.shape[1] // 3
        return np.argwhere(np.ptp(picture[:, panel * width : (panel + 1) * width], axis=-1) > 25)


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[Any]:
    viewers: list[Viewer] = []

    def open_page(truth: Trajectory, **predictions: Trajectory) -> Viewer:
        write_viewer(tmp_path / "viewer.html", truth, predictions)
        viewers.append(Viewer(browser, tmp_path / "viewer.html"))
        return viewers[-1]

    yield open_page
    for viewer in viewers:
        assert viewer.problems == []
        assert [url.partition(":")[0] for url in viewer.requests] == ["file"]  # the page itself
        viewer.page.close()


@pytest.mark.slow
def test_particles_fall_as_time_passes(opened: Any) -> None:
    viewer = opened(falling(2), GPE=falling(2, noise=0.3))
    first = [viewer.colored(panel)[:, 0].mean() for panel in range(3)]
    viewer.page.locator("#frame").fill("11")
    last = [viewer.colored(panel)[:, 0].mean() for panel in range(3)]
    assert all(after > before + 20 for before, after in zip(first, last, strict=True))
    assert viewer.page.locator("#time").inner_text().startswith("0.22 s   frame 11\nerror ")


@pytest.mark.slow
def test_it_plays_to_the_end_and_begins_again(opened: Any) -> None:
    viewer = opened(falling(3), GPE=falling(3, noise=0.3))
    viewer.page.locator("#stage").focus()
    viewer.page.keyboard.press("ArrowRight")
    assert "frame 1" in viewer.page.locator("#time").inner_text()
    viewer.page.click("#play")
    seen = [1]
    for _ in range(3000):  # a slow browser skips frames, but stays at the last one for a while
        seen.append(int(viewer.page.locator("#time").inner_text().split("frame ")[1].split()[0]))
        if seen[-1] < seen[-2]:
            break
        viewer.page.wait_for_timeout(10)
    assert seen[-2] == 11 > seen[-1]
    viewer.page.click("#play")
    assert viewer.page.get_attribute("#play", "aria-label") == "play"


@pytest.mark.slow
def test_it_does_not_step_back_when_it_begins_to_play(opened: Any) -> None:
    """A picture that the browser began before the click has an earlier time."""
    viewer = opened(falling(3), GPE=falling(3, noise=0.3))
    viewer.page.locator("#frame").fill("6")
    viewer.page.evaluate(
        """() => {
            const next = window.requestAnimationFrame.bind(window);
            window.requestAnimationFrame = (draw) => next((time) => draw(time - 200));
            window.lowest = 6;
            new MutationObserver(() => {
                const frame = Number(document.querySelector("#time").innerText.split("frame ")[1].split(/\\s/)[0]);
                window.lowest = Math.min(window.lowest, frame);
                window.isAtEnd ||= frame === 11;
            }).observe(document.querySelector("#time"), { childList: true, characterData: true, subtree: true });
        }"""
    )
    viewer.page.click("#play")
    viewer.page.wait_for_function("() => window.isAtEnd")
    assert viewer.page.evaluate("() => window.lowest") == 6


@pytest.mark.slow
def test_colours_mean_what_is_chosen(opened: Any) -> None:
    truth = falling(2)
    viewer = opened(replace(truth, node_type=np.full(truth.num_nodes, node_code("snow"), np.uint8)))
    viewer.page.select_option("#color", "material")
    wanted = np.array([int(MATERIAL_COLORS["snow"][k : k + 2], 16) for k in (1, 3, 5)])
    assert (np.abs(viewer.picture() - wanted).max(axis=-1) <= 2).sum() > 200
    viewer.page.select_option("#color", "speed")
    assert (np.abs(viewer.picture() - wanted).max(axis=-1) <= 2).sum() == 0
    assert viewer.page.locator(".bar").inner_text().split("\n")[:2] == ["0 m/s", "speed"]


@pytest.mark.slow
def test_a_mesh_is_coloured_by_its_stress(opened: Any, mesh: Trajectory) -> None:
    assert mesh.stress is not None
    node = np.zeros_like(mesh.stress.node)
    node[..., 0] = np.linspace(0, 1e5, mesh.num_frames)[:, None]
    viewer = opened(replace(mesh, stress=Stress(node, mesh.stress.cell)))
    counts = []
    for frame in (0, 11):
        viewer.page.locator("#frame").fill(str(frame))
        red, green, _ = np.moveaxis(viewer.picture()[:-40], -1, 0)
        counts.append(int((red - green > 60).sum()))
    assert counts[0] == 0 and counts[1] > 500
    assert viewer.page.locator(".bar").inner_text().split("\n")[1] == "von Mises stress"


@pytest.mark.slow
def test_a_colour_bar_marks_values_above_its_end(opened: Any) -> None:
    truth = falling(2)
    vel = np.ones_like(truth.vel)
    vel[3, 0] = 50.0
    viewer = opened(replace(truth, vel=vel))
    viewer.page.select_option("#color", "speed")
    assert viewer.page.locator(".bar").inner_text().split("\n") == ["0 m/s", "speed", "≥ 1.41 m/s"]


@pytest.mark.slow
def test_panels_say_how_many_nodes_they_do_not_show(opened: Any) -> None:
    truth = falling(2)
    pos = truth.pos.copy()
    pos[6:, :3], pos[8:, 3:5] = [0.5, 1.4], np.nan
    viewer = opened(truth, GPE=replace(truth, pos=pos))
    notes = viewer.page.locator(".title > span")
    for frame, expected in ((5, ""), (7, "3 of 25 nodes are outside"), (8, "3 of 25 nodes are outside, 2 of 25 nodes are missing")):
        viewer.page.locator("#frame").fill(str(frame))
        assert notes.all_inner_texts() == ["", expected, expected]
    assert "rms" in viewer.page.locator("#time").inner_text()


@pytest.mark.slow
def test_cells_do_not_stretch_across_a_periodic_domain(opened: Any) -> None:
    mesh = falling_mesh(2)
    metadata = replace(mesh.metadata, periodic=(True, False))
    viewer = opened(replace(mesh, metadata=metadata, pos=mesh.pos + np.array([0.5, 0.0])))
    viewer.page.select_option("#color", "material")
    picture = viewer.picture()[:-40]
    between = picture[:, 450:530]  # of the cells at both sides, and right of the loose particles
    assert (np.ptp(picture, axis=-1) > 40).sum() > 500 and (np.ptp(between, axis=-1) > 40).sum() == 0


@pytest.mark.slow
def test_predictions_take_turns_and_one_that_stopped_says_why(opened: Any) -> None:
    truth, other = falling(2), falling(2, noise=0.3)
    stopped = replace(other.frames(0, 7), termination=Termination("explosion", 7, 0, "frame 7: too fast"))
    viewer = opened(truth, GPE=other, GNS=stopped)
    viewer.page.locator("#frame").fill("9")
    assert viewer.page.locator("h2").all_inner_texts() == ["ground truth", "GPE", "error"]
    viewer.page.select_option("#prediction", label="GNS")
    assert viewer.page.locator("h2").all_inner_texts() == ["ground truth", "GNS", "error"]
    notes = viewer.page.locator(".stopped:visible").all_inner_texts()
    assert notes == ["stopped at 0.14 s (explosion)"] * 2
    assert len(viewer.colored(0)) > 100 and len(viewer.colored(1)) == 0


@pytest.mark.slow
def test_the_mouse_finds_a_node_in_every_panel_and_turns_a_scene(opened: Any) -> None:
    viewer = opened(falling(3), GPE=falling(3, noise=0.3))
    row, column = viewer.colored(0).mean(axis=0)
    viewer.page.mouse.move(column, row + viewer.page.locator("#stage").bounding_box()["y"])
    assert "node" in viewer.page.locator("#tooltip").inner_text()
    assert viewer.page.locator(".ring:visible").count() == 3
    before = viewer.picture()
    viewer.page.mouse.down()
    viewer.page.mouse.move(column + 120, row + 100, steps=3)
    viewer.page.mouse.up()
    assert (viewer.picture() != before).any(axis=-1).mean() > 0.02
    viewer.page.mouse.move(1, 1)
    viewer.page.click("#reset")


@pytest.mark.slow
def test_the_mouse_says_at_least_where_a_stored_value_is_cut(opened: Any) -> None:
    truth = falling(2)
    vel = truth.vel + np.array([0.0, -1.0])
    vel[8, 12] = [0.0, -1e7]
    viewer = opened(replace(truth, vel=vel), GPE=falling(2, noise=0.3))
    stage = viewer.page.locator("#stage").bounding_box()

    def speeds(frame: int) -> list[str]:
        """Return what the tooltips of nodes say about the speed."""
        viewer.page.locator("#frame").fill(str(frame))
        found = []
        for row, column in viewer.colored(0)[::10]:
            viewer.page.mouse.move(float(column), float(row + stage["y"]))
            found += [line.strip() for line in viewer.page.locator("#tooltip").inner_text().splitlines() if "speed" in line]
        return found

    assert {text.startswith("speed ≥") for text in speeds(8)} == {False, True}
    assert {text.startswith("speed ≥") for text in speeds(7)} == {False}


def test_walls_that_move_have_no_error(opened: Any) -> None:
    truth = falling(2)
    wall = np.array([[0.3, 0.05], [0.4, 0.05]]) + 0.01 * np.arange(truth.num_frames)[:, None, None]
    moving = Boundary.moving(wall, np.array([[0.0, 1.0]] * 2), truth.metadata.frame_dt)
    viewer = opened(replace(truth, boundary=moving), GPE=replace(falling(2, noise=0.3), boundary=moving))
    shades = viewer.page.evaluate("Array.from(window.viewer.shades[2])")
    assert len(shades) == truth.num_nodes + 2
    assert min(shades[:-2]) >= 0 and shades[-2:] == [-1, -1]


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def mesh(request: pytest.FixtureRequest) -> Trajectory:
    return falling_mesh(request.param)


@pytest.mark.slow
def test_two_predictions_are_a_distance_apart(opened: Any) -> None:
    truth, other = falling(2), falling(2, noise=0.3)
    first, second = replace(truth, is_prediction=True), replace(other, is_prediction=True, material_params=truth.material_params + 10)
    viewer = opened(first, steep=second)
    assert viewer.page.locator("h2").all_inner_texts() == ["prediction", "steep", "distance"]
    assert "distance from the first rollout" in viewer.page.locator(".bar").last.inner_text()
    assert "distance" in viewer.page.locator("#time").inner_text()
    assert viewer.page.locator("#materials").inner_text() == "sand"


@pytest.mark.slow
@pytest.mark.parametrize("width", [360, 414])
def test_colour_bars_are_below_the_pictures_on_a_phone(opened: Any, width: int) -> None:
    truth = falling(2)
    viewer = opened(truth, GPE=falling(2, noise=0.3))
    viewer.page.set_viewport_size({"width": width, "height": 700})
    bars = viewer.page.evaluate("[...document.querySelectorAll('.panel')].map(p => [p.querySelector('.bar'), p])"
        ".filter(([bar]) => bar).map(([bar, panel]) => [bar.offsetTop + bar.offsetHeight, bar.offsetTop, panel.clientHeight])")  # fmt: skip
    assert len(bars) >= 2
    for bottom, top, height in bars:
        assert top >= height - 34 and bottom <= height
