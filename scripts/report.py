"""Put many runs side by side, as one page: `python scripts/report.py runs/...`; see `--help`."""

from gridworld.commands import run
from gridworld.commands.report import main

if __name__ == "__main__":
    run(main)
