"""Show how the jobs of a sweep stand: `python scripts/jobs.py runs/...`; see `--help`."""

from gridworld.commands import run
from gridworld.commands.jobs import main

if __name__ == "__main__":
    run(main)
