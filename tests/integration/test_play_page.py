"""The page to play with, in a browser and from a plain file server. Skipped without a browser."""

from __future__ import annotations

import base64
import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.export.play_page import PARTS, PageFolderError, SolverFilm, bundled, write_page
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import rollout
from gpe_pl.scenes import play
from tests.integration.test_play_steps import FLOOR, SIDE, scene

PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
NUM_FRAMES = 30


def film(simulator: LearnedSimulator) -> SolverFilm:
    """Return a film in which particles fly freely."""
    metadata = simulator.builder.metadata
    state = scene(simulator, (FLOOR, SIDE))
    return SolverFilm("flight", rollout(Ballistic(metadata.frame_dt), state, simulator.builder.config.history + NUM_FRAMES, metadata))


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("page")
    simulator = LearnedSimulator.from_checkpoint("sand")
    write_page(folder, {"sand": simulator, "other": simulator}, {"other": [film(simulator)]})
    with play.server(folder, 0) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()
        thread.join()


@pytest.fixture
def page(browser: Any, address: str, request: pytest.FixtureRequest) -> Iterator[Any]:
    """An open page, paused. It requests nothing but its own files."""
    context = browser.new_context(reduced_motion="reduce", **getattr(request, "param", {}))
    opened, problems, requests = context.new_page(), list[str](), list[str]()
    opened.on("pageerror", lambda error: problems.append(str(error)))
    opened.on("console", lambda message: problems.append(message.text))
    opened.on("request", lambda sent: requests.append(sent.url))
    opened.goto(address)
    opened.wait_for_function("window.gpePage")
    yield opened
    assert problems == []
    assert all(url.startswith((address, "data:")) for url in requests)
    context.close()


def nodes(page: Any) -> np.ndarray:
    """Return position and velocity of the particles [node, 4]."""
    values = page.evaluate("[Array.from(gpePage.world.state.pos), Array.from(gpePage.world.state.vel)]")
    return np.concatenate([np.reshape(v, (-1, 2)) for v in values], axis=1)


def advance(page: Any, num_steps: int) -> None:
    page.evaluate("count => { for (let k = 0; k < count; k++) gpePage.step(); }", num_steps)


def pixel(page: Any, x: float, y: float) -> tuple[float, float]:
    """Return the place on the screen of a point in metres."""
    return page.evaluate(
        """([x, y]) => { const p = gpePage.panel, box = p.canvas.getBoundingClientRect(); p.fit();
        return [box.left + (p.x0 + p.scale * x) / p.density, box.top + (p.y0 - p.scale * y) / p.density]; }""",
        [x, y],
    )


@pytest.mark.slow
def test_blocks_fall_when_the_page_plays(page: Any) -> None:
    assert page.locator("#rate").inner_text() in ("", "paused")  # the reader's system asks for reduced motion
    before = nodes(page)
    page.locator("#play").click()
    page.wait_for_function("gpePage.world.time > 0.05")
    page.locator("#play").click()
    assert (nodes(page)[:, 1] < before[:, 1]).all()
    page.wait_for_function("document.getElementById('kinetic').textContent !== '0 J'")


@pytest.mark.slow
@pytest.mark.parametrize("page", [{}, PHONE], indirect=True, ids=["desktop", "phone"])
def test_everything_fits_and_buttons_are_large_enough(page: Any) -> None:
    width = page.viewport_size["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert all(button.bounding_box()["height"] >= 40 for button in page.locator("button").all())


@pytest.mark.slow
def test_a_block_is_thrown_by_dragging(page: Any) -> None:
    x, y = nodes(page)[:, :2].max(axis=0) - 0.08
    held = np.hypot(*(nodes(page)[:, :2] - (x, y)).T) < 0.05
    page.mouse.move(*pixel(page, x, y))
    page.mouse.down()
    page.mouse.move(*pixel(page, x - 0.3, y + 0.1))
    advance(page, 10)
    page.mouse.up()
    assert "Thrown" in page.locator("#status").inner_text()
    assert (nodes(page)[held, 2] < -0.5).all()
    there = nodes(page)[held, 0]
    advance(page, 5)
    assert (nodes(page)[held, 0] < there).all()


@pytest.mark.slow
def test_the_keyboard_moves_an_obstacle(page: Any) -> None:
    def center() -> list[float]:
        return page.evaluate("gpePage.world.obstacles[0].center")

    page.evaluate("gpePage.cursor = gpePage.world.obstacles[0].center")
    page.locator("#stage").focus()
    before = center()
    page.keyboard.press("Space")
    for _ in range(5):
        page.keyboard.press("ArrowUp")
    advance(page, 60)
    page.keyboard.press("Space")
    assert center()[1] == pytest.approx(before[1] + 0.1, abs=0.01)
    assert center()[0] == pytest.approx(before[0], abs=0.01)


@pytest.mark.slow
def test_keys_add_remove_and_restart(page: Any) -> None:
    count = len(nodes(page))
    page.locator("#stage").focus()
    for _ in range(4):
        page.keyboard.press("Shift+ArrowUp")
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("b")
    added = len(nodes(page))
    assert added > count
    page.keyboard.press("Delete")
    assert len(nodes(page)) == count
    page.keyboard.press("o")
    assert page.evaluate("gpePage.world.obstacles.length") == 2
    page.keyboard.press("r")
    assert page.evaluate("gpePage.world.obstacles.length") == 1


@pytest.mark.slow
def test_the_slider_sets_the_parameter(page: Any) -> None:
    page.locator("#parameter-0").fill("0")
    low = LearnedSimulator.from_checkpoint("sand").get_buffer("trained_sand")[0, 0]
    assert page.evaluate("gpePage.world.state.params[0]") == pytest.approx(float(low))
    assert page.locator("#value-0").inner_text() == f"{float(low):.1f} °"


@pytest.mark.slow
def test_the_film_runs_beside_the_model(page: Any) -> None:
    assert page.locator("#film-side").is_hidden()
    page.locator("#model").select_option(label="other")
    assert page.locator("#film-side").is_visible()
    start = nodes(page)[:, :2]
    first = page.evaluate("Array.from(gpePage.choice.frames.slice(0, 2 * gpePage.choice.count), v => v / 65535)")
    np.testing.assert_allclose(np.reshape(first, (-1, 2)), start, atol=1e-4)
    advance(page, NUM_FRAMES)
    page.wait_for_function("document.getElementById('film-note').textContent === 'the film has ended'")


@pytest.mark.slow
def test_a_failed_model_stops_with_a_message(page: Any) -> None:
    page.evaluate("gpePage.world.state.vel[0] = NaN")
    advance(page, 2)
    assert "failed" in page.locator("#status").inner_text()
    page.locator("#reset").click()
    advance(page, 1)
    assert "failed" not in page.locator("#status").inner_text()


@pytest.mark.slow
def test_the_canvas_fits_a_phone_on_its_side(browser: Any, address: str) -> None:
    context = browser.new_context(viewport={"width": 740, "height": 340}, has_touch=True, is_mobile=True)
    opened = context.new_page()
    opened.goto(address)
    opened.wait_for_function("window.gpePage")
    box = opened.locator("#stage").bounding_box()
    assert box["height"] < 340 and box["width"] < 740
    context.close()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_scene_follows_the_size_of_the_domain(browser: Any, tmp_path: Path, factor: float) -> None:
    """A model of a box of 10 cm or 10 m: the same scene, smaller or larger."""
    simulator = LearnedSimulator.from_checkpoint("sand")
    path = write_page(tmp_path, {"sand": simulator})
    opened = browser.new_page(reduced_motion="reduce")
    opened.goto(path.as_uri())
    opened.wait_for_function("window.gpePage")
    before, obstacle = nodes(opened), opened.evaluate("gpePage.world.obstacles[0]")
    scale = "model.spacing *= factor; model.bounds = model.bounds.map(axis => axis.map(value => value * factor));"
    opened.evaluate(f"factor => {{ const model = gpeModels[0]; {scale} gpePage.open(0); }}", factor)
    after = opened.evaluate("gpePage.world.obstacles[0]")
    np.testing.assert_allclose(nodes(opened)[:, :2], factor * before[:, :2], rtol=1e-9)
    np.testing.assert_allclose([*after["center"], after["radius"]], factor * np.array([*obstacle["center"], obstacle["radius"]]))
    opened.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["play", "a#1", "50%25", "<b>"])
def test_a_model_may_have_any_name(browser: Any, tmp_path: Path, name: str) -> None:
    opened = browser.new_page(reduced_motion="reduce")
    opened.goto(write_page(tmp_path, {name: LearnedSimulator.from_checkpoint("sand")}).as_uri())
    opened.wait_for_function("window.gpePage")
    assert opened.evaluate("gpeModels[0].name") == name
    assert opened.title() == "Play with learned sand"
    opened.close()


@pytest.mark.slow
def test_a_page_without_its_model_says_so(browser: Any, tmp_path: Path) -> None:
    path = write_page(tmp_path, {"sand": LearnedSimulator.from_checkpoint("sand")})
    (tmp_path / "model_0.js").unlink()
    opened = browser.new_page()
    opened.goto(path.as_uri())
    assert "model_0.js" in opened.locator("#status").inner_text()
    opened.close()


def test_the_script_names_every_part() -> None:
    script = bundled()
    assert all(f"gpe_{path.stem} = " in script for path in PARTS.glob("*.mjs"))
    assert re.search(r"^(import|export) ", script, flags=re.MULTILINE) is None


def test_a_page_without_models_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PageFolderError, match="at least one model"):
        write_page(tmp_path, {})


def test_the_command_writes_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["gpe play", "snow", f"folder={tmp_path}"])
    play.main()
    assert capsys.readouterr().out.strip() == str(tmp_path / "index.html")
    assert '<script src="model_0.js">' in (tmp_path / "index.html").read_text()


@pytest.mark.slow
def test_the_command_films_the_solver(tmp_path: Path) -> None:
    play.write(tmp_path, ["snow"], 1)
    about = json.loads((tmp_path / "model_0.js").read_text().partition("push(")[2].rpartition(")")[0])
    (scene,) = about["scenes"]
    assert scene["numFrames"] == play.NUM_FRAMES + 1
    film = np.frombuffer(base64.b64decode(scene["film"]), "<u2").reshape(scene["numFrames"], scene["count"], 2)
    np.testing.assert_allclose(film[0] / 65535, np.reshape(scene["pos"], (-1, 2)), atol=1e-4)
    assert film[-1, :, 1].mean() < film[0, :, 1].mean()  # it has fallen


@pytest.mark.parametrize(
    ("arguments", "answer"),
    [
        (["fem"], "a model of meshes (solid)"),
        (["sandd"], "did you mean 'sand'"),
        (["sand", "film=1"], "did you mean 'films'"),
    ],
)
def test_the_command_refuses_in_one_line(
    arguments: list[str], answer: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["gpe play", *arguments, f"folder={tmp_path}"])
    with pytest.raises(SystemExit):
        play.main()
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and answer in error


def test_a_port_in_use_is_refused(tmp_path: Path) -> None:
    with play.server(tmp_path, 0) as first, pytest.raises(play.PortFault, match="port=0 for any free one"):
        play.server(tmp_path, first.server_address[1])


def test_a_port_in_use_is_refused_before_the_page_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(play, "write", lambda *_: pytest.fail("the page was made"))
    with play.server(tmp_path, 0) as first, pytest.raises(play.PortFault):
        play.run("sand", {"port": first.server_address[1], "open": False})
