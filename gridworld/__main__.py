"""The console command `gridworld`, also `python -m gridworld`; see `gridworld.commands.console`."""

from gridworld.process.signals import listen


def main() -> None:
    """Run the command line in `sys.argv`."""
    listen()  # before what takes time to import
    from gridworld.commands.console import main

    main()


if __name__ == "__main__":
    main()
