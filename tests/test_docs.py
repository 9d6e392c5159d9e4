"""The pages of the documentation: every command and every block of code on them runs."""

import ast
import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.colours import check_words
from helpers.pages import PAGES, Reader, blocks, check, module_of
from helpers.support import ROOT, configure
from PIL import Image

import gridworld
from gridworld.config.settings import flat

CLAIMS: dict[str, tuple[str, list[str]]] = {  # by a part of a command: what it prints, and words to add
    "hydra.run.dir=runs/defaults": ("not optimal", []),
    "diagnose.py runs/defaults": ("exploration", []),
    "observation=coordinates": ("certified optimal since step", ["evaluation.stop_after=1"]),
    "observation=image": ("certified optimal since step", ["evaluation.stop_after=1"]),
    "train.py --help": ("Choices:", []),
    "check.py q_learning": ("passed all", ["--processes", "1"]),
    "check.py stable_baselines3.A2C": ("1 probe", ["--processes", "1"]),
    "MiniGrid-Empty-5x5-v0": ("enumerated", ["env.kwargs={max_steps: 20}", "total_timesteps=1000"]),
}


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Reader:
    return Reader(tmp_path_factory.mktemp("clone"), CLAIMS)


def test_every_claim_is_of_a_command_on_a_page() -> None:
    text = "\n".join(page.read_text("utf-8") for page in PAGES)
    assert [part for part in CLAIMS if part not in text] == []


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=lambda page: page.stem)
def test_a_page_runs(page: Path, reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(reader.folder)
    monkeypatch.syspath_prepend(reader.folder)  # as for Python that is started there
    torch.set_num_threads(1)  # networks this small take longer with more
    reader.read(page)


def test_commands_within_sentences_are_read() -> None:
    for page in PAGES:
        text = " ".join(page.read_text("utf-8").split())
        for command in re.findall(r"`(python scripts/(?!NAME)[^`]+)`", text):
            check(command)


# Turns that a reader stumbles over, and the usual ones.
TURNS = {
    r"told|tells": "say, print, show",
    r"beside": "next to, compared with, in addition to",
    r"seldom": "rarely",
    r"stands? (in|beside)": "is in",
    r"(go(es)?|went) on\b(?! to)": "resume, continue",
    r"anew": "again",
    r"begun": "started",
    r"there (is|are) no such": "no such",
    r"put that right": "fix that",
    r"of one's own|of a function of your own": "your own, custom",
    r"is at work": "is running",
    r"otherwise than": "differently from",
    r"(came|come|comes) to (its|their|the) end": "finish",
    r"(the )?settings that the search began from": "the baseline",
    r"if that is meant": "if you mean that",
    r"close to it are": "close matches",
    r"brings? in": "use",
    r"by itself": "automatically, alone",
    r"(came|comes) out": "result",
    r"in the place of": "instead of",
    r"gives? up": "cancel, abandon",
    r"(?<!there )is no (?!longer)\w+": "is not a",
    r"\w*learnt": "learned",
}


def unusual(text: str) -> dict[str, str]:
    """The turns in a text, with the usual words."""
    return {turn: usual for turn, usual in TURNS.items() if re.search(rf"\b({turn})\b", text, re.IGNORECASE)}


@pytest.mark.slow
def test_pages_messages_and_help_use_the_usual_words() -> None:
    """All strings of the package with a space, except docstrings; a command's docstring is its help."""
    whole = [
        *PAGES,
        *(path for name in ("docs", "scripts") for path in (ROOT / name).rglob("*.py")),
        *(ROOT / "conf").rglob("*.yaml"),
        *(ROOT / "gridworld").rglob("*.j2"),
        *(ROOT / name for name in ("docs/CITATION.cff", "docs/benchmarks/rl_zoo.yml", "pyproject.toml")),
    ]
    texts = {str(path.relative_to(ROOT)): path.read_text("utf-8") for path in whole}
    for path in (ROOT / "docs").rglob("*.ipynb"):
        page = module_of("notebook").page(path.read_text("utf-8"))
        texts[str(path.relative_to(ROOT))] = re.sub(r"base64,[^)\"]+", "", page)
    found = {name: turns for name, text in texts.items() if (turns := unusual(text))}
    for path in sorted((ROOT / "gridworld").rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        if path.parent.name == "commands" and isinstance(tree.body[0], ast.Expr):
            docstrings.remove(id(tree.body[0].value))
        for node in ast.walk(tree):
            text = node.value if isinstance(node, ast.Constant) and id(node) not in docstrings else ""
            if isinstance(text, str) and " " in text and (turns := unusual(text)):
                found[f"{path.relative_to(ROOT)}:{node.lineno}"] = turns
    assert not found


def test_the_pictures_are_the_ones_that_a_command_draws() -> None:
    figures = module_of("figures")
    assert {path.name for path in figures.IMAGES.iterdir()} == set(figures.SOURCES)
    assert sum(path.stat().st_size for path in figures.IMAGES.iterdir()) < 600_000
    for path in figures.IMAGES.glob("*.png"):  # for light pages and dark ones
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGBA"))
        assert not pixels[0, :, 3].all()
        rows = (pixels[..., 3] > 240).any(axis=1)
        first = int(rows.argmax())  # what begins there is a line of words
        check_words(pixels[first : first + int(rows[first:].argmin())])
    for line in figures.COMMANDS.splitlines():
        check(line)


def test_the_tables_of_options_are_complete() -> None:
    """Every setting, option and argument has a row, and every row says what it is for."""
    tables = module_of("option_tables")
    page = (ROOT / "docs" / "reference" / "options.md").read_text("utf-8")
    assert set(re.findall(r"<!-- table: (\w+) -->", page)) == set(tables.TABLES)
    filled = tables.fill(page)
    rows = [line.split(" | ") for line in filled.splitlines() if line.startswith("| `")]
    assert not [row for row in rows if not row[-1].strip(" |")]
    keys = {row[0].strip("| `") for row in rows}
    for agent in ("dqn", "ppo", "a2c", "q_learning", "value_iteration"):
        settings = flat(dataclasses.asdict(configure(f"agent={agent}")))
        known = {
            key for key, *_ in settings if not key.startswith(("agent.arguments.", "agent.policy_kwargs."))
        }
        assert known <= keys, known - keys
    for command in ("evaluate", "export", "record", "report", "tune"):
        assert f"### `{command}`" in filled
    assert {"num_envs", "slip", "tune.trials", "hydra.launcher.partition", "--cell-size"} <= keys


def test_the_api_reference_has_every_public_name() -> None:
    page = (ROOT / "docs" / "reference" / "api.md").read_text("utf-8")
    assert set(re.findall(r"gridworld\.(\w+)\b", page)) >= set(gridworld.__all__)
