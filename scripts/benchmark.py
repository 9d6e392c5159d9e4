"""Measure this project beside its peers: `python scripts/benchmark.py`; see `--help`."""

from gridworld.commands import run
from gridworld.commands.benchmark import main

if __name__ == "__main__":
    run(main)
