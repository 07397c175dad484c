import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from gpe_pl.viz.coloring import REFERENCE, Coloring
from gpe_pl.viz.video import PANEL_PIXELS, FilmError, _images, write_animation


def frames_of(path) -> list[np.ndarray]:
    with Image.open(path) as image:
        frames = []
        for k in range(getattr(image, "n_frames", 1)):
            image.seek(k)
            frames.append(np.asarray(image.convert("RGB")).astype(int))
        return frames


def particles(image) -> np.ndarray:
    """Return row and column of the coloured pixels."""
    return np.argwhere(np.ptp(image, axis=-1) > 40)


@pytest.mark.slow
def test_gif_has_every_frame_and_particles_fall_in_both_panels(tmp_path, ground_truth, prediction):
    path = tmp_path / "new" / "rollout.gif"
    write_animation(path, ground_truth, {"GPE": prediction}, fps=20)
    frames = frames_of(path)
    assert len(frames) == ground_truth.num_frames
    middle = frames[0].shape[1] // 2
    for panel in (slice(None, middle), slice(middle, None)):
        first, last = particles(frames[0][:, panel]), particles(frames[-1][:, panel])
        assert len(first) > 100 and len(last) > 100
        assert last[:, 0].mean() > first[:, 0].mean() + 20
    assert [p.name for p in path.parent.iterdir()] == ["rollout.gif"]
    with Image.open(path) as image:
        assert image.info["duration"] == 50 and image.info["loop"] == 0


def test_the_clock_tells_short_frames_apart(tmp_path, ground_truth):
    """Where nothing moves, equal frames become one."""
    still = replace(ground_truth, pos=ground_truth.pos[:1].repeat(5, axis=0), vel=0 * ground_truth.vel[:5])
    write_animation(tmp_path / "a.gif", replace(still, metadata=replace(still.metadata, frame_dt=2e-3)), {})
    assert len(frames_of(tmp_path / "a.gif")) == 5


@pytest.mark.slow
def test_moved_particles_leave_no_trace(tmp_path, ground_truth):
    write_animation(tmp_path / "a.gif", ground_truth, {})
    write_animation(tmp_path / "b.gif", ground_truth, {}, stride=ground_truth.num_frames - 1)
    last, alone = (frames_of(tmp_path / f"{name}.gif")[-1] for name in "ab")
    assert np.abs(last - alone).max() < 60  # each film has its palette
    assert tuple(last[40, 20]) == (255, 255, 255) or tuple(last[-3, 3]) == (255, 255, 255)


@pytest.mark.slow
@pytest.mark.parametrize("color", ["height", "speed"])
def test_colours_of_a_gif_are_those_of_its_scale(tmp_path, ground_truth, color):
    """Far nodes are paler and edges darker than the scale; none may look like what has no value."""
    vel = np.gradient(ground_truth.pos, axis=0) + 0.1 * np.random.default_rng(0).normal(size=ground_truth.pos.shape)
    moving = replace(ground_truth, vel=vel)
    write_animation(tmp_path / "a.gif", moving, {}, color=color)
    frames = range(moving.num_frames)
    drawn = _images({"ground truth": moving}, frames, Coloring(color, [moving], frames), PANEL_PIXELS)
    neutral = 255 * np.array(to_rgb(REFERENCE))
    for stored, exact in zip(frames_of(tmp_path / "a.gif"), drawn, strict=True):
        true = exact.astype(int)
        colored, paper = np.ptp(true, axis=-1) > 35, (true == 255).all(axis=-1)
        error = np.abs(stored - true).max(axis=-1)
        assert error[colored].mean() < 6 and (stored[paper] == 255).all() and stored[true.max(axis=-1) < 60].max() < 110
        looks_neutral = colored & (np.abs(stored - neutral).max(axis=-1) < 4)
        assert not (looks_neutral & (np.abs(true - neutral).max(axis=-1) > 16)).any()


@pytest.mark.slow
def test_stride_skips_frames_and_errors_have_colours(tmp_path, ground_truth, prediction):
    write_animation(tmp_path / "a.gif", ground_truth, {"GPE": prediction}, stride=5, color="error")
    frames = frames_of(tmp_path / "a.gif")
    assert len(frames) == 3
    right = frames[-1][:, frames[-1].shape[1] // 2 :]
    assert ((right[..., 0] > 200) & (right[..., 2] < 120)).any()  # large errors are yellow, which the first frame lacks


@pytest.mark.slow
def test_a_stopped_rollout_empties_its_panel(tmp_path, ground_truth, stopped):
    write_animation(tmp_path / "a.gif", ground_truth, {"GPE": stopped})
    frames = frames_of(tmp_path / "a.gif")
    assert len(frames) == ground_truth.num_frames
    right = frames[-1][:, frames[-1].shape[1] // 2 :]
    assert len(particles(right)) == 0 and (right < 150).any()


@pytest.mark.slow
def test_mp4_can_be_read_back(tmp_path, ground_truth, prediction):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "a.mp4"
    write_animation(path, ground_truth, {"GPE": prediction})
    assert ffmpeg.count_frames_and_secs(str(path))[0] == ground_truth.num_frames
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_mp4_without_ffmpeg_names_what_to_install(tmp_path, ground_truth, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ModuleNotFoundError, match="pip install imageio-ffmpeg"):
        write_animation(tmp_path / "a.mp4", ground_truth, {})


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path, ground_truth, prediction, monkeypatch):
    path = tmp_path / "a.gif"
    path.write_bytes(b"old")
    monkeypatch.setattr("gpe_pl.viz.panel.Panel.show_frame", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_animation(path, ground_truth, {"GPE": prediction})
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.avi", {}, "gif or .mp4"),
        ("a.gif", {"stride": 0}, "stride"),
        ("a.gif", {"fps": 0}, "fps=0: must"),
        ("a.gif", {"fps": 60}, "50 frames"),
        ("a.gif", {"fps": math.nan}, "fps=nan: must"),
        ("a.gif", {"fps": 0.001}, "fps=0.001: must"),
        ("a.mp4", {"fps": math.inf}, "fps=inf: must"),
    ],
)
def test_senseless_requests_are_refused(tmp_path, ground_truth, name, options, message):
    with pytest.raises(ValueError, match=message):
        write_animation(tmp_path / name, ground_truth, {}, **options)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files as POSIX does")
def test_a_film_that_does_not_fit_is_refused_and_leaves_nothing(tmp_path, ground_truth):
    """ffmpeg only says so by a file without frames."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    truncating = tmp_path / "truncating"
    truncating.write_text(f'#!/bin/sh\nulimit -f 4\nexec {imageio_ffmpeg.get_ffmpeg_exe()} "$@"\n', encoding="utf-8")
    truncating.chmod(0o755)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("IMAGEIO_FFMPEG_EXE", str(truncating))
        with pytest.raises(FilmError, match=r"films/a\.mp4: ffmpeg could not write the film"):
            write_animation(tmp_path / "films" / "a.mp4", ground_truth, {})
    assert not list((tmp_path / "films").iterdir())
