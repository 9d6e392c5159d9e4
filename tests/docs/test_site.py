"""The site builds without a warning, and no page is wider than the window."""

import itertools
import json
import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from helpers.browser import FITS, check_transparent, chromium, look_at
from helpers.support import ROOT

FORMULA = re.compile(r"\$\$.+?\$\$|\$.+?\$", re.DOTALL)
PARTS = ("table", "img.align-right", "iframe")
WIDTHS = (390, 1280, 1440, 1600)
PAGES = (  # by what may be too wide: pictures, tables, long commands, tables of options, signatures, formulas
    "index",
    "faq",
    "how-to/agents",
    "how-to/speed",
    "reference/results",
    "reference/optimal-values",
    "reference/options",
    "reference/api",
    "course/lab1_values",
)
PICTURES = ("faq", "how-to/runs", "tutorials/quickstart", "tutorials/standing-still")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", str(ROOT / "docs"), str(folder)]
    subprocess.run(command, check=True, timeout=300)
    return folder


@pytest.mark.slow
def test_the_sheets_are_pages_whose_formulas_need_no_network(site: Path) -> None:
    for sheet in (ROOT / "docs" / "course").glob("*.ipynb"):
        page = (site / "course" / f"{sheet.stem}.html").read_text("utf-8")
        assert page.count("<math") == sum(
            len(FORMULA.findall("".join(cell["source"])))
            for cell in json.loads(sheet.read_text("utf-8"))["cells"]
            if cell["cell_type"] == "markdown"
        )
        assert not re.search(r'(?:src|rel="stylesheet" href)="http', page)
        [notebook] = (site / "_downloads").rglob(sheet.name)
        assert notebook.read_bytes() == sheet.read_bytes()
    assert not (site / "course" / "solutions").exists()


@pytest.mark.slow
def test_the_first_screen_says_how_to_start_and_where_to_go(site: Path, tmp_path: Path) -> None:
    """With the README's words. The playground below is as high as it is."""
    with chromium(tmp_path) as browser:
        screen = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        browser.get((site / "index.html").as_uri())
        code, output = browser.find_elements("css selector", "article pre")
        doors, picture, frame = (browser.find_element("css selector", f"article {each}") for each in PARTS)
        assert code.text in (ROOT / "README.md").read_text("utf-8")
        assert "certified optimal" in output.text
        assert doors.rect["y"] + doors.rect["height"] <= 900
        assert picture.rect["x"] > output.rect["x"] + output.rect["width"]
        links = [each.get_attribute("href") for each in doors.find_elements("tag name", "a")]
        assert all(Path(unquote(urlsplit(link).path)).is_file() for link in links)
        browser.execute_script("arguments[0].scrollIntoView()", frame)
        browser.switch_to.frame(frame)
        browser.execute_async_script(FITS)


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1280])
def test_pictures_lie_on_the_page_whether_it_is_light_or_dark(site: Path, tmp_path: Path, width: int) -> None:
    with chromium(tmp_path) as browser:
        for scheme, page in itertools.product(("light", "dark"), PICTURES):
            shot = look_at(browser, site / f"{page}.html", scheme, width, 900)
            check_transparent(browser, shot, "article img:not([src$='.gif'])")
        look_at(browser, site / "index.html", "dark", width, 900)
        film = browser.find_element("css selector", "article img[src$='.gif']")
        assert film.value_of_css_property("border-top-width") == "1px"  # which has a ground of its own


@pytest.mark.slow
def test_no_page_is_wider_than_the_window(site: Path, tmp_path: Path) -> None:
    with chromium(tmp_path) as browser:
        too_wide = []
        for width in WIDTHS:
            size = {"width": width, "height": 1000, "deviceScaleFactor": 1, "mobile": False}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            for page in PAGES:
                browser.get((site / f"{page}.html").as_uri())
                wide, window = browser.execute_script(
                    "return [document.documentElement.scrollWidth, window.innerWidth]"
                )
                assert window == width
                if wide > window:
                    too_wide.append((page, width, wide))
    assert not too_wide
