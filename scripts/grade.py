"""Mark a student's lab sheet: `python scripts/grade.py 1 my_sheet.ipynb`; see `--help`."""

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import
    from gridworld.commands import call

    call("grade")
