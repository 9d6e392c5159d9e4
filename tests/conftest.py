"""Settings for all tests: no screen, and the same examples on every run."""

import os

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # before pygame is imported

from hypothesis import settings

settings.register_profile("gridworld", derandomize=True, deadline=None, database=None, max_examples=30)
settings.load_profile("gridworld")
