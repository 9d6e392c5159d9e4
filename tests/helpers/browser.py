"""A headless Chromium for the tests that look at pages; they are skipped where there is none."""

import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

# In a frame that becomes as high as its page: waits until it is, without a scroll bar; fails if it never is.
FITS = """
const [done] = arguments, page = document.documentElement;
const fits = () => Math.ceil(document.body.getBoundingClientRect().height) === innerHeight;
const look = () => (fits() && page.clientWidth === innerWidth ? done() : setTimeout(look, 20));
look();
"""


@contextmanager
def chromium(profile: Path) -> Iterator[Any]:
    """A browser with a new profile in that folder."""
    missing = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    if missing and not os.environ.get("GRIDWORLD_REQUIRE_BROWSER"):
        pytest.skip(f"not installed: {' and '.join(missing)} (Debian: chromium, chromium-driver)")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for argument in (
        *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
        *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
        *(f"--user-data-dir={profile}", "--window-size=1400,1600"),  # what is below may not be drawn
        "--disable-3d-apis",  # without a GPU, TensorBoard draws lines as SVG in half the time
    ):
        options.add_argument(argument)
    browser = webdriver.Chrome(options=options, service=Service(str(shutil.which("chromedriver"))))
    try:
        yield browser
    finally:
        browser.quit()


def look_at(browser: Any, page: Path, scheme: str, width: int, height: int) -> Image.Image:
    """Open a page, light or dark, in a window of that size; a screenshot of all that it has, in RGB."""
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.get(page.as_uri())
    length = browser.execute_script("return document.documentElement.scrollHeight")
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen | {"height": length})
    return Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")


def check_transparent(browser: Any, shot: Image.Image, selector: str) -> None:
    """At the corner of each of these pictures the page is as it is to the left of it."""
    pictures = [each.rect for each in browser.find_elements("css selector", selector) if each.is_displayed()]
    assert pictures
    for rect in pictures:
        left, top = round(rect["x"]), round(rect["y"])
        assert shot.getpixel((left + 2, top + 2)) == shot.getpixel((left - 3, top + 2)), rect
