"""Search an agent's settings: `python scripts/tune.py agent=ppo env=four_rooms`; see `--help`."""

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import call

    call("tune")
