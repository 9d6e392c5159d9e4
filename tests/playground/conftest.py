"""One browser for all tests of the page, and the pages that it opens."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.browser import chromium
from helpers.support import SHORT, train_in

from gridworld.config.compose import named_world
from gridworld.report.playground.page import run_page, world_page
from gridworld.training.saved_run import SavedRun


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture(scope="session")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page of the default world, and two runs with theirs: one on a map, one without."""
    folder = tmp_path_factory.mktemp("pages")
    (folder / "world.html").write_text(world_page(named_world("classic"), 0.99, 100))
    for name, env in (("map", "aima_4x3"), ("table", "river_swim")):
        train_in(folder / name, *SHORT["q_learning"], f"env={env}", "evaluation.every=500")
        (folder / f"{name}.html").write_text(run_page(SavedRun(folder / name)))
    return folder


@pytest.fixture
def page(browser: Any, pages: Path) -> Iterator[Callable[..., Any]]:
    """Opens one of the pages, or another file, and looks for errors afterwards."""

    def opened(link: str = "", name: str | Path = "world.html") -> Any:
        browser.get("about:blank")
        browser.get(f"{(pages / name).as_uri()}#{link}")
        return browser

    yield opened
    assert browser.get_log("browser") == []
