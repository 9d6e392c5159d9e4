"""Export a finished run's episodes as pictures: `python scripts/record.py runs/...`; see `--help`."""

from gridworld.commands import run
from gridworld.commands.record import main

if __name__ == "__main__":
    run(main)
