"""Runs the notebook of docs/examples and stores what it shows: `python docs/notebook.py`; half a minute."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

NOTEBOOK = Path(__file__).parent / "examples" / "quickstart.ipynb"


def execute(folder: Path) -> Any:
    """The notebook with all outputs of a run in a folder, progress included."""
    import nbclient
    import nbformat

    notebook = nbformat.read(NOTEBOOK, 4)
    metadata = json.loads(json.dumps(notebook.metadata))
    place = {"metadata": {"path": str(folder)}}
    client = nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3", resources=place)
    client.record_timing = False
    client.execute()
    notebook.metadata = metadata  # without the version of Python
    return notebook


def to_store(notebook: Any) -> Any:
    """Without the lines of progress, which depend on the clock, and with one format of each picture."""
    for cell in notebook.cells:
        if "outputs" in cell:
            cell["outputs"] = [each for each in cell["outputs"] if each.get("name") != "stderr"]
            for each in cell["outputs"]:
                each["data"].pop("image/jpeg", None)
    return notebook


def page(text: str) -> str:
    """A notebook in Markdown for the site."""
    cells = json.loads(text)["cells"]
    parts = []
    for cell in cells:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        parts += [_shown(output["data"]) for output in cell.get("outputs", [])]
    return "\n\n".join(parts)


def _shown(data: dict[str, Any]) -> str:
    html, picture = "".join(data.get("text/html", "")), "".join(data.get("image/png", "")).strip()
    if picture:
        html = f'<img src="data:image/png;base64,{picture}" alt="what the line above draws">'
    if html:
        return f"```{{raw}} html\n{html}\n```"
    return f"```{{code-block}} text\n:class: wrapped\n\n{''.join(data['text/plain'])}\n```"


def main() -> None:
    """Run it in a temporary folder, and store it where it was."""
    import nbformat

    with tempfile.TemporaryDirectory() as folder:
        nbformat.write(to_store(execute(Path(folder))), NOTEBOOK)


if __name__ == "__main__":
    main()
