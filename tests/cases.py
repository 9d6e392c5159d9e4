"""Tables of cases in text files, a case per line."""

from pathlib import Path

_ROOT = Path(__file__).parent


def table(file: str, title: str) -> list[list[str]]:
    """The columns, between arrows, of all rows of the section that begins with `# TITLE:`.

    `\\n` is the end of a line in a column; what begins with # is a comment.
    """
    text = (_ROOT / file).read_text("utf-8")
    section = next(part for part in text.split("\n\n") if part.startswith(f"# {title}:"))
    rows = [row.replace("\\n", "\n") for row in section.splitlines() if not row.startswith("#")]
    return [row.split("  =>  ") for row in rows]
