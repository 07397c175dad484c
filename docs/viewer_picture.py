"""``python docs/viewer_picture.py``: the picture of the embedded viewer in the guide, ``docs/images/viewer.png``.

Needs ``docs/_static/viewer.html`` (``python docs/viewer_page.py``), playwright and a Chromium.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from playwright.sync_api import sync_playwright

DOCS = Path(__file__).resolve().parent
PAGE = DOCS / "_static" / "viewer.html"
PICTURE = DOCS / "images" / "viewer.png"
FRAME = "35"


def main() -> None:
    """Open the viewer in a browser and photograph one frame."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--use-angle=swiftshader"])
        page = browser.new_page(viewport={"width": 1100, "height": 480}, device_scale_factor=1.5)
        page.goto(PAGE.as_uri())
        page.wait_for_selector("#message", state="hidden")
        page.locator("#frame").fill(FRAME)
        PICTURE.write_bytes(page.screenshot())
        browser.close()


if __name__ == "__main__":
    main()
