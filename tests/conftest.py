"""Settings for all tests: no screen, and the same examples on every run."""

import os
from collections.abc import Iterator

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # before pygame is imported

import pytest
from hypothesis import settings

settings.register_profile("gridworld", derandomize=True, deadline=None, database=None, max_examples=30)
settings.load_profile("gridworld")


@pytest.fixture(autouse=True)
def _environment() -> Iterator[None]:
    """What a test, or the program in it, does to the environment variables ends with the test."""
    before = dict(os.environ)
    yield
    os.environ.clear()
    os.environ.update(before)
