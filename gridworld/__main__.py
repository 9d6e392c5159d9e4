"""The console command `gridworld`, also `python -m gridworld`; see `gridworld.commands`."""

from gridworld.base.signals import listen


def main() -> None:
    """Run the command line in `sys.argv`."""
    listen()  # before what takes time to import
    from gridworld.commands import console

    console()


if __name__ == "__main__":
    main()
