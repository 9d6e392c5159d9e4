"""Export a finished run's episodes as pictures: `python scripts/record.py runs/...`; see `--help`."""

from gridworld.process.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import run
    from gridworld.commands.record import main

    run(main)
