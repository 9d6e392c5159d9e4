"""Check an implementation on probe worlds: `python scripts/check.py my_package.MyPPO`; see `--help`."""

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import call

    call("check")
