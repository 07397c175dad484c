"""The picture of the guide's page on uncertainty, ``docs/images/uncertainty.png``: a rollout with its error bands, and the ground truth.

``python docs/uncertainty_picture.py MODEL DATA_SET`` takes a shipped model with stored bands, and the first scene of the split ``test_unseen`` of a data set in
2D. ``docs/rollout_bands.py`` makes both.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.collections import EllipseCollection
from PIL import Image

from gpe_pl import LearnedSimulator, iter_trajectories, read_bands, roll_out_with_bands
from gpe_pl.learned.bands import LEVEL
from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.film_strip import new_figure
from gpe_pl.viz.saving import save_figure

PICTURE = Path(__file__).resolve().parent / "images" / "uncertainty.png"
SHOWN = (10, 30, 60)
"""Frames after the start of the rollout."""


def main(model: str, root: Path) -> None:
    """Roll the scene out, and draw nodes, bands and ground truth in three frames."""
    simulator, bands = LearnedSimulator.from_checkpoint(model), read_bands(model)
    if bands is None:
        sys.exit(f"{model}: has no stored bands; run docs/rollout_bands.py")
    scene = next(iter_trajectories(root, "test_unseen"))
    start = simulator.initial_state(scene, bands.start_frame)
    found = roll_out_with_bands(simulator, start, max(SHOWN), scene.metadata, bands)
    assert found.radius is not None
    figure = new_figure(9.5, 2.9)
    figure.set_layout_engine("constrained")
    for axes, frame in zip(figure.subplots(1, len(SHOWN)), SHOWN, strict=True):
        predicted, truth = (t.pos[k].astype(np.float64) for t, k in ((found.trajectory, frame), (scene, bands.start_frame + frame)))
        size = 2 * found.radius[frame]
        circles = {"units": "xy", "offsets": predicted, "transOffset": axes.transData, "color": PALETTE[0], "alpha": 0.06}
        axes.add_collection(EllipseCollection(size, size, np.zeros(len(size)), **circles))
        inside = np.linalg.norm(predicted - truth, axis=1) <= found.radius[frame]
        for mask, color in ((inside, "black"), (~inside, PALETTE[1])):
            axes.plot(*truth[mask].T, ".", markersize=2.5, color=color)
        (left, right), (low, high) = scene.metadata.bounds
        axes.set(xlim=(left, right), ylim=(low, low + 0.7 * (high - low)), aspect="equal", xticks=[], yticks=[])
        axes.set_title(
            f"after {frame * scene.metadata.frame_dt:g} s: {100 * inside.mean():.0f} % of nodes in bands of {100 * LEVEL:g} %", fontsize=8
        )
    save_figure(figure, PICTURE, dpi=110)
    with Image.open(PICTURE) as drawn:
        drawn.convert("RGB").quantize(64).save(PICTURE, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(sys.argv[1], Path(sys.argv[2]))
