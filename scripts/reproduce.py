"""Run a run again and compare bit for bit: `python scripts/reproduce.py runs/...`; see `--help`."""

from gridworld.commands import run
from gridworld.commands.reproduce import main

if __name__ == "__main__":
    run(main)
