"""Draw worlds and watch Q-learning in the browser: `python scripts/playground.py cliff`; see `--help`."""

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import call

    call("playground")
