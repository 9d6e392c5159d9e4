"""Examine an environment: `python scripts/examine.py my_module:MyEnv`; see `--help`."""

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import call

    call("examine")
