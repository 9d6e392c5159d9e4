"""Search an agent's settings: `python scripts/tune.py agent=ppo env=four_rooms`; see `--help`."""

from gridworld.commands import run
from gridworld.commands.tune import main

if __name__ == "__main__":
    run(main)
