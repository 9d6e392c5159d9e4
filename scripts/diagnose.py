"""Say why a finished run is not optimal: `python scripts/diagnose.py runs/...`; see `--help`."""

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import call

    call("diagnose")
