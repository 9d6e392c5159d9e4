"""Play a world with the arrow keys: `python scripts/play.py --layout maze`; see `--help`."""

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import call

    call("play")
