"""``python docs/viewer_page.py`` writes ``docs/_static/viewer.html``, the viewer of the shipped sand model that the guide embeds.

This takes half a minute. Run it again when the viewer or the shipped sand model changes.
"""

from __future__ import annotations

from pathlib import Path

from gpe_pl import LearnedSimulator, dataset, generate_trajectory, roll_out, write_viewer

PAGE = Path(__file__).resolve().parent / "_static" / "viewer.html"
NUM_FRAMES = 150
STRIDE = 2


def write_page(path: Path, num_frames: int = NUM_FRAMES, stride: int = STRIDE) -> None:
    """Roll the shipped sand model out in a scene that training did not have, and write its viewer."""
    simulator = LearnedSimulator.from_checkpoint("sand")
    truth = generate_trajectory(dataset("data=sand", "size=small"), split="test", index=0, values={"sand": 27.5})
    start = simulator.builder.config.history
    prediction = roll_out(simulator, simulator.initial_state(truth, start), num_frames, truth.metadata)
    write_viewer(path, truth.frames(start, start + num_frames + 1), {"GPE": prediction}, stride=stride)


if __name__ == "__main__":
    write_page(PAGE)
