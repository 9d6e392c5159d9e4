"""Train an agent: `python scripts/train.py agent=dqn`; `--help` tells the rest."""

from pathlib import Path

from gridworld.experiment import main

if __name__ == "__main__":
    main(Path(__file__).resolve().parents[1] / "conf")
