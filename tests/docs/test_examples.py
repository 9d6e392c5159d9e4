"""The programs and the notebook of docs/examples run as they stand there."""

import base64
import io
import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.pages import module_of
from helpers.support import ROOT, script
from PIL import Image

EXAMPLES = ROOT / "docs" / "examples"
PRINTED = {
    "train_and_look.py": "from the start it goes",
    "exact_callback_with_plain_sb3.py": "the best model: regret 0.000, certified optimal: True",
    "score_your_own_table.py": "certified optimal",
    "family_of_worlds.py": "| all | 1 | 1 | 1 | 1 |",
    "check_a_numpy_agent.py": "train: passed all 14 probes",
    "optimal_values.py": "| CliffWalking-v1 | 1 | -13.000000 | -13.000000 | 13.00 | 100.0 % |",
}
ARGUMENTS = {
    "family_of_worlds.py": ["dqn", "--pairs", "2", "--observations", "one_hot"],
    "optimal_values.py": ["CliffWalking-v1"],
}
OPTIMA = module_of("examples/optimal_values")
ENUMERATED = ("Blackjack-v1", "MiniGrid-Empty-5x5-v0")


def test_all_examples_are_tried() -> None:
    run_by_its_page = "from_rl_zoo.py"
    assert {path.name for path in EXAMPLES.glob("*.py")} == {*PRINTED, run_by_its_page}


def test_a_section_of_rl_zoo_becomes_an_agent() -> None:
    """What is Python in it is read, not run."""
    zoo = module_of("examples/from_rl_zoo")
    section = {
        "normalize": True,
        "n_envs": 8,
        "n_timesteps": 1e5,
        "policy": "MlpPolicy",
        "n_steps": 32,
        "policy_kwargs": "dict(net_arch=dict(pi=[64], vf=[64]), activation_fn=nn.ReLU, ortho_init=False)",
    }
    settings, left = zoo.converted("ppo", section)
    kwargs = {"net_arch": {"pi": [64], "vf": [64]}, "activation_fn": "torch.nn.ReLU", "ortho_init": False}
    assert settings == {
        "n_envs": 8,
        "total_timesteps": 100_000,
        "agent": {
            "name": "zoo_ppo",
            "algorithm": "stable_baselines3.PPO",
            "policy": "MlpPolicy",
            "arguments": {"n_steps": 32, "policy_kwargs": kwargs},
        },
    }
    assert left == ["normalize"]
    for text in ("__import__('os').getcwd()", "dict(a=open('b'))"):
        with pytest.raises(ValueError, match="malformed"):
            zoo.converted("ppo", section | {"policy_kwargs": text})
    with pytest.raises(SystemExit, match="sac: is not for discrete actions"):
        zoo.converted("sac", section)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRINTED)
def test_an_example(name: str, tmp_path: Path) -> None:
    done = script(str(EXAMPLES / name), *ARGUMENTS.get(name, []), cwd=tmp_path, OMP_NUM_THREADS="1")
    assert done.returncode == 0, done.stderr
    assert PRINTED[name] in done.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in ENUMERATED)) for name in OPTIMA.WORLDS]
)
def test_the_page_of_optimal_values_has_what_its_command_prints(name: str) -> None:
    if name.startswith("MiniGrid"):
        pytest.importorskip("minigrid")
    rows, policy = OPTIMA.optimum(name)
    page = (ROOT / "docs" / "reference" / "optimal-values.md").read_text("utf-8")
    assert [line for line in page.splitlines() if line.startswith(f"| {name} |")] == rows
    assert f"## {name}\n\n```text\n{policy}\n```\n" in page


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_notebook_shows_what_is_stored_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import nbformat

    notebook = module_of("notebook")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    done = notebook.execute(tmp_path)
    output = str([each for cell in done.cells for each in cell.get("outputs", [])])
    assert "dqn on classic: step 0 of 30,000 (0%)" in output
    assert "(100%), regret 0" in output
    shown, stored = _shown(notebook.to_store(done)), _shown(nbformat.read(notebook.NOTEBOOK, 4))
    assert [text for text, _ in shown] == [text for text, _ in stored]
    for (_, pictures), (_, kept) in zip(shown, stored, strict=True):
        for one, other in zip(pictures, kept, strict=True):
            assert np.abs(one - other).mean() < 8, "draw it again: python docs/notebook.py"  # of 255
    assert sum(len(pictures) for _, pictures in stored) == 4  # two curves and two policies


def _shown(notebook: Any) -> list[tuple[str, list[Any]]]:
    """Of each output its text without numbers, which a processor may change, and its pictures, made small."""
    found = []
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            text = output.data.get("text/html", "") + output.data["text/plain"]
            coded = [*re.findall(r"base64,([^\"]+)", text), *filter(None, [output.data.get("image/png")])]
            pictures = [Image.open(io.BytesIO(base64.b64decode(each))) for each in coded]
            small = [np.asarray(each.convert("L").resize((64, 64)), float) for each in pictures]
            found.append((re.sub(r"base64,[^\"]+|[\d.,]+(e-\d+)?", "#", text), small))
    return found
