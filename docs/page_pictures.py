"""Draw the pictures of docs/audit.md, the page of an audit of a simulated room: python docs/page_pictures.py

Needs playwright and a Chromium, as the tests of the pages do.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import l2p

IMAGES = Path(__file__).parent / "images"
CHROMIUM = "/usr/bin/chromium"
POINTS, SEED = 5000, 3
#: Name, width and height of the window, height of the picture, and whether it is a phone.
WINDOWS = (("audit", 1280, 900, 900, False), ("audit-phone", 390, 844, 1080, True))


def main() -> None:
    """Audit the room and take the pictures."""
    from playwright.sync_api import sync_playwright

    audit = l2p.audit(l2p.simulate("room", POINTS, SEED), [1, 0.1], name="the room", metric=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        l2p.save_report(audit, Path(folder) / "report")
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        for name, width, height, shown, phone in WINDOWS:
            size: Any = {"width": width, "height": height}
            page = browser.new_page(viewport=size, color_scheme="light", is_mobile=phone, has_touch=phone)
            page.goto((Path(folder) / "report" / "index.html").as_uri())
            page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
            part: Any = {"x": 0, "y": 0, "width": width, "height": shown}
            page.screenshot(path=IMAGES / f"{name}.png", full_page=True, clip=part)
            print(IMAGES / f"{name}.png")
        browser.close()


if __name__ == "__main__":
    main()
