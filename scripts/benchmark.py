"""Measure the speed of this project and its peers: `python scripts/benchmark.py`; see `--help`."""

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import call

    call("benchmark")
