"""The README's first commands are the ones that CI runs, and what the pages name exists."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
import yaml
from helpers.pages import PAGES, README, blocks
from helpers.support import ROOT, script

import gridworld

INSTALL, *OTHERS = blocks(README, "bash")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
KNOWN = PROJECT.get("urls", {}).get("Repository")  # the one setting of the address
ADDRESS = KNOWN or "ADDRESS"  # where none is known, a placeholder


def test_the_first_two_commands_are_the_ones_ci_runs() -> None:
    clone, install = INSTALL.lines
    assert clone.split()[::2] == ["git", ADDRESS, "&&", "gridworld"]
    assert install == "pip install -e . && python scripts/train.py agent=dqn"
    assert "pip install -e '.[test]' && python -m pytest" in [block.text.strip() for block in OTHERS]
    assert "README.md" in (ROOT / ".ci" / "run").read_text()


def test_it_is_short() -> None:
    assert len(README.read_text("utf-8").splitlines()) <= 200
    assert len(OTHERS) >= 3


def test_the_main_job_prints_what_the_readme_shows(tmp_path: Path) -> None:
    _, path, *words = shlex.split(INSTALL.lines[-1].split("&&")[1])
    done = script(Path(path).name, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    shown = next(block.text for block in blocks(README, "text") if "greedy" in block.text)

    def form(text: str) -> list[str]:
        """Without numbers, which another processor's rounding may change, and without the folder's name."""
        lines = [line for line in text.strip().splitlines() if "runs/" not in line]
        return [" ".join(re.sub(r"[\d.,]+", "#", line).split()) for line in lines]

    assert form(done.stdout) == form(shown)
    assert "certified optimal since step" in done.stdout


def test_an_optional_part_is_installed_on_the_page_that_needs_it() -> None:
    """In an earlier line."""
    words = {"tune": "scripts/tune.py", "slurm": "launcher=slurm", "ray": "launcher=ray"}
    for page in PAGES:
        lines = [line for block in blocks(page, "bash", "text") for line in block.lines]
        for extra, word in words.items():
            needing = [
                place for place, line in enumerate(lines) if line.startswith("python") and word in line
            ]
            if needing:
                assert f"pip install -e '.[{extra}]'" in " ".join(lines[: needing[0]]), page


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_it_names_exists(page: Path) -> None:
    text = page.read_text("utf-8")
    for path in re.findall(r"\]\(([\w./-]+)\)", text):
        assert (page.parent / path).is_file(), path
    for path in re.findall(r"`((?:gridworld|conf|docs|scripts|tests)/[\w./]*)`", text):
        assert (ROOT / path).exists(), path
    for name in re.findall(r"`(\w+\.py)`", text):
        assert list(ROOT.glob(f"*/**/{name}")), name


def test_the_version_is_in_the_citation_and_the_changelog() -> None:
    citation = yaml.safe_load((ROOT / "docs" / "CITATION.cff").read_text())
    assert citation["version"] == gridworld.__version__
    assert citation["license"] == PROJECT["license"]
    assert citation.get("repository-code") == KNOWN
    sections = re.findall(r"^## (.*)", (ROOT / "docs" / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert sections[0] == "[Unreleased]"
    assert all(re.fullmatch(r"\[\d+\.\d+\.\d+\] - \d{4}-\d\d-\d\d", each) for each in sections[1:])
    assert sections[1].startswith(f"[{gridworld.__version__}]")
