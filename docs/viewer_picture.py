"""``python docs/viewer_picture.py``: the picture of the viewer in the guide, ``docs/images/viewer.png``, of a model that comes with the package.

Needs playwright and a Chromium.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

from gpe_pl import LearnedSimulator, dataset, generate_trajectory, roll_out, write_viewer

PICTURE = Path(__file__).resolve().parent / "images" / "viewer.png"
FRAME = "70"


def main() -> None:
    """Roll out, write the viewer, look at one frame of it."""
    simulator = LearnedSimulator.from_checkpoint("sand")
    truth = generate_trajectory(dataset("data=sand", "size=small"), split="test", index=0, values={"sand": 27.5})
    start = simulator.builder.config.history
    prediction = roll_out(simulator, simulator.initial_state(truth, start), truth.num_frames - 1 - start, truth.metadata)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page_file = Path(folder) / "viewer.html"
        write_viewer(page_file, truth.frames(start), {"GPE": prediction})
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--use-angle=swiftshader"])
        page = browser.new_page(viewport={"width": 1100, "height": 480}, device_scale_factor=1.5)
        page.goto(page_file.as_uri())
        page.wait_for_selector("#message", state="hidden")
        page.locator("#frame").fill(FRAME)
        PICTURE.write_bytes(page.screenshot())
        browser.close()


if __name__ == "__main__":
    main()
