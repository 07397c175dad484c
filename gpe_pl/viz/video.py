"""Animations of a rollout beside the ground truth: GIF, or MP4 if imageio-ffmpeg is installed."""

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replacing
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.camera import Camera
from gpe_pl.viz.captions import as_written, frame_time, in_common, pictured
from gpe_pl.viz.coloring import COLOR_MAPS, REFERENCE, ColorBy, Coloring
from gpe_pl.viz.film_strip import draw_bar, draw_legend, evenly_spaced_frames
from gpe_pl.viz.panel import HAZE, Panel
from gpe_pl.viz.scenery import INK

PANEL_PIXELS, FILM_PIXELS = 360, 960
CHARACTER_PIXELS = 7
"""Approximate width of a character of the line that names materials, in pixels."""
DPI = 100
BAR_PIXELS, BAR_WIDTH = 44, 240
"""Height of the scale of colours with its numbers and label, and width of the scale, in pixels."""

SLOWEST = 0.01
"""Lowest frame rate of an animation [frames/s]. A GIF can show a frame for at most some minutes."""
SAMPLES = 8
"""Number of frames whose colours determine the palette of a GIF."""
BYTES = np.array([1 << 16, 1 << 8, 1])
"""Factors that pack red, green and blue into one integer."""


class FilmError(GpeError):
    """Raised when a film is incomplete. ffmpeg itself does not report this to the program that calls it."""


def write_animation(
    path: Path | str,
    ground_truth: Trajectory,
    predictions: Mapping[str, Trajectory],
    fps: int | float = 25,
    stride: int = 1,
    color: ColorBy = "height",
) -> None:
    """Write the ground truth and predictions side by side; the file appears complete or not at all.

    Args:
        path: file that ends in ``.gif`` or ``.mp4``.
        ground_truth: first trajectory, which sets the length. If it is a prediction, its panel is called ``prediction``.
        predictions: rollouts from frame 0 of the ground truth, by the name of their panel.
        fps: frames per second of the animation; a GIF rounds the time of a frame to 10 ms.
        stride: step between shown frames of the trajectory.
        color: ``height`` colours particles by their height at the start, ``error`` predicted particles by their distance from the ground truth; others as
            in ``Coloring``.

    Raises:
        ValueError: the file type is unknown, the stride is not positive, the frame rate is below ``SLOWEST``, a GIF has more than 50 frames per second, no
            trajectory has the values for ``color``, or a prediction has the name of the first panel.
        FilmError: ffmpeg could not write the whole MP4.
        FullDiskError: there is no room for a GIF.
        ModuleNotFoundError: MP4 without imageio-ffmpeg.
    """
    frames = range(0, ground_truth.num_frames, stride) if stride >= 1 else range(0)
    rows = pictured(ground_truth, predictions)
    _write(Path(path), rows, frames, fps, color, next(iter(rows.values())), PANEL_PIXELS)


def write_film(path: Path | str, name: str, trajectory: Trajectory, fps: int | float = 25, color: ColorBy = "height") -> None:
    """Write an animation of a single trajectory, larger than in ``write_animation``. ``name`` is the title of its panel; other arguments are as there."""
    _write(
        Path(path),
        {name: trajectory.with_moving_boundary().with_absent_hidden()},
        range(trajectory.num_frames),
        fps,
        color,
        None,
        FILM_PIXELS,
    )


def _write(
    path: Path, rows: dict[str, Trajectory], frames: range, fps: int | float, color: ColorBy, truth: Trajectory | None, panel_pixels: int
) -> None:
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path}: an animation ends in .gif or .mp4")
    if len(frames) == 0:
        raise ValueError(f"{path}: stride must be positive, and there must be a frame to show")
    if not SLOWEST <= fps < math.inf:  # NaN fails all comparisons
        raise ValueError(f"{path}: fps={fps}: must be a number of at least {SLOWEST}")
    with replacing(path) as part:
        coloring = Coloring(color, list(rows.values()), frames, truth)
        images = _images(rows, frames, coloring, panel_pixels)
        if path.suffix == ".gif":
            samples = [frames[k] for k in evenly_spaced_frames(len(frames), SAMPLES)]
            _write_gif(part, images, fps, _palette(_images(rows, samples, coloring, panel_pixels), color))
        else:
            _write_mp4(part, images, fps, path)


def _images(rows: dict[str, Trajectory], frames: Sequence[int], coloring: Coloring, panel_pixels: int) -> Iterator[np.ndarray]:
    """Yield RGB images [height, width, 3], one per shown frame. Boundaries and titles are drawn once and restored below the particles."""
    first = next(iter(rows.values()))
    aspect = Camera(first).aspect

    line, gap = 24, 8
    words = [*filter(None, [in_common(list(rows.values())), coloring.explanation])]
    characters = int(len(rows) * panel_pixels / CHARACTER_PIXELS)
    caption = (
        [text] if len(text := "; ".join(words)) <= characters else [part for word in words for part in textwrap.wrap(word, characters)]
    )
    legend = coloring.legend(rows.values())
    key = BAR_PIXELS if coloring.bar_label else line if legend else 0
    title = line * (1 + len(caption)) + key
    width = len(rows) * panel_pixels + (len(rows) + 1) * gap
    height = round(panel_pixels * aspect) + title + gap
    width, height = width + width % 2, height + height % 2  # H.264 needs even sizes
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    panels = []
    for k, (name, trajectory) in enumerate(rows.items()):
        left = gap + k * (panel_pixels + gap)
        box = (left / width, gap / height, panel_pixels / width, panel_pixels * aspect / height)
        panels.append(Panel(figure, box, trajectory, coloring))
        figure.text(
            (left + panel_pixels / 2) / width, 1 - line / 2 / height, as_written(name), ha="center", va="center", fontsize=10, color=INK
        )
    for k, text in enumerate(caption):
        figure.text(0.5, 1 - line * (1.5 + k) / height, text, ha="center", va="center", fontsize=9, color=INK)
    if coloring.bar_label:
        wide = min(BAR_WIDTH, width - 2 * gap)
        box = ((width - wide) / 2 / width, 1 - (title - key + 8) / height, wide / width, 8 / height)
        draw_bar(figure, coloring, coloring.bar_label, box, "horizontal")
    elif legend:
        draw_legend(figure, legend, 1 - title / height)
    clock = figure.text(gap / width, 1 - line / 2 / height, "", ha="left", va="center", fontsize=9, color=INK)

    moving = [*(artist for panel in panels for artist in panel.artists), clock]
    for artist in moving:
        artist.set_animated(True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for frame in frames:
        canvas.restore_region(background)
        for panel in panels:
            panel.show_frame(frame)
        clock.set_text(frame_time(frame, first))
        for artist in moving:
            figure.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _palette(images: Iterable[np.ndarray], color: ColorBy) -> Image.Image:
    """Return the 256 colours of a GIF: paper, and the 255 that represent the colours of these images and of the scale of ``color`` best.

    The palette is fixed, because one palette per frame flickers. The images are a few of the film. Other frames may have further colours of the scale, also
    paler ones of far nodes.
    """
    packed = np.concatenate([np.unique(image.reshape(-1, 3) @ BYTES, return_counts=True) for image in images], axis=1)
    values, which = np.unique(packed[0], return_inverse=True)
    drawn = np.stack([values >> 16, values >> 8 & 255, values & 255], axis=-1)
    # Rare colours count, too: weigh each by the root of its number of pixels.
    weight = np.sqrt(np.bincount(which, packed[1])).round().astype(int)
    # Pillow finds nearest colours only approximately: without colours next to white, paper stays white.
    is_paper = drawn.min(axis=1) > 246
    drawn = drawn[~is_paper].repeat(weight[~is_paper], axis=0)
    hues = np.concatenate([COLOR_MAPS[color](np.linspace(0, 1, 64))[:, :3], [to_rgb(REFERENCE)]])
    scale = np.concatenate([1 - (1 - white) * (1 - hues) for white in (0, HAZE / 2, HAZE)])
    scale = np.round(255 * scale).repeat(1 + len(drawn) // (5 * len(scale)), axis=0)
    pixels = np.concatenate([drawn, scale]).astype(np.uint8)
    best = Image.fromarray(pixels[None]).quantize(255, Image.Quantize.MEDIANCUT, kmeans=1).getpalette() or []
    image = Image.new("P", (1, 1))
    image.putpalette(bytes(best[: 3 * 255]).ljust(3 * 256, b"\xff"))
    return image


def _write_gif(path: Path, images: Iterator[np.ndarray], fps: int | float, palette: Image.Image) -> None:
    if fps > 50:
        raise ValueError(f"a GIF shows at most 50 frames per second, got {fps:g}; raise stride or write an MP4")
    pictures = (Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    # The format stores times in hundredths of a second.
    next(pictures).save(path, format="GIF", save_all=True, append_images=pictures, duration=10 * round(100 / fps), loop=0)


def _write_mp4(path: Path, images: Iterator[np.ndarray], fps: int | float, shown: Path) -> None:
    """Write images to a path; errors call it ``shown``."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ModuleNotFoundError("MP4 needs imageio-ffmpeg: `pip install imageio-ffmpeg`, or write a .gif") from None
    first = next(images)
    size = (first.shape[1], first.shape[0])
    # With the index at the front, a browser starts playing before the file is complete.
    writer = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=fps,
        codec="libx264",
        quality=8,
        macro_block_size=2,
        ffmpeg_log_level="quiet",
        output_params=["-movflags", "+faststart"],
    )
    count, reason = 0, "it ended early"
    try:
        writer.send(None)
        for image in chain([first], images):
            writer.send(np.ascontiguousarray(image))
            count += 1
        writer.close()
        written = imageio_ffmpeg.count_frames_and_secs(str(path))[0]
        if written == count:
            return
        reason = f"{written} of {count} frames are in the file"
    except (OSError, RuntimeError, IndexError):  # IndexError is raised for a file without frames
        pass
    finally:
        writer.close()
    raise FilmError(f"{shown}: ffmpeg could not write the film ({reason}); is the disk full?")
