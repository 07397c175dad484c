"""``python docs/play_picture.py``: the picture of the page of ``gpe play`` in the guide, ``docs/images/play.png``.

Needs playwright and a Chromium.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

PICTURE = Path(__file__).resolve().parent / "images" / "play.png"
NUM_STEPS = 75


def main() -> None:
    """Write the page of the shipped sand model with one film of the solver, and photograph it after some steps."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        subprocess.run([sys.executable, "-m", "gpe_pl", "play", "sand", "films=1", f"folder={folder}"], check=True)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        page = browser.new_page(viewport={"width": 1100, "height": 620}, reduced_motion="reduce")
        page.goto((Path(folder) / "index.html").as_uri())
        page.wait_for_function("window.gpePage")
        page.locator("#scene").select_option(index=1)
        page.evaluate("count => { for (let k = 0; k < count; k++) gpePage.step(); gpePage.draw(); }", NUM_STEPS)
        PICTURE.write_bytes(page.screenshot())
        browser.close()


if __name__ == "__main__":
    main()
