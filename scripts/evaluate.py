"""Score a finished run again: `python scripts/evaluate.py runs/...`; see `--help`."""

from gridworld.commands import run
from gridworld.commands.evaluate import main

if __name__ == "__main__":
    run(main)
