"""The programs and the notebook of docs/examples run as they stand there."""

import os
import sys
from pathlib import Path

import pytest
from helpers.support import ROOT, script

EXAMPLES = ROOT / "docs" / "examples"
TOLD = {
    "train_and_look.py": "from the start it goes",
    "exact_callback_with_plain_sb3.py": "the best model: regret 0.000, certified optimal: True",
    "score_your_own_table.py": "certified optimal",
    "family_of_worlds.py": "| all | 1 | 1 | 1 | 1 |",
    "check_a_numpy_agent.py": "train: passed all 11 probes",
}
ARGUMENTS = {"family_of_worlds.py": ["dqn", "--pairs", "2", "--observations", "one_hot"]}


def test_all_examples_are_tried() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(TOLD)


@pytest.mark.parametrize("name", TOLD)
def test_an_example(name: str, tmp_path: Path) -> None:
    done = script(str(EXAMPLES / name), *ARGUMENTS.get(name, []), cwd=tmp_path, OMP_NUM_THREADS="1")
    assert done.returncode == 0, done.stderr
    assert TOLD[name] in done.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("ignore")
def test_the_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import nbclient
    import nbformat

    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    notebook = nbformat.read(EXAMPLES / "quickstart.ipynb", 4)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
    place = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3", resources=place).execute()
    outputs = [each for cell in notebook.cells for each in cell.get("outputs", [])]
    output, shown = str(outputs), [each["data"] for each in outputs if "data" in each]
    assert "RunResult(dqn on classic, seed 0" in output
    assert "dqn on classic: step 0 of 30,000 (0%)" in output
    assert "(100%), regret 0" in output
    assert "6 jobs: 6 done" in output
    assert sum("image/png" in data for data in shown) == 2  # a curve and a policy
    assert [data["text/html"].count("<img ") for data in shown if "text/html" in data] == [2, 0]
