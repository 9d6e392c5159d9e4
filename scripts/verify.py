"""Prove how good a finished run's policy is: `python scripts/verify.py runs/...`; see `--help`."""

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import call

    call("verify")
