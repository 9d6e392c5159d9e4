"""Play a world with the arrow keys: `python scripts/play.py --layout maze`; see `--help`."""

from gridworld.commands import run
from gridworld.commands.play import main

if __name__ == "__main__":
    run(main)
