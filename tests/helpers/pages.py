"""The pages of the documentation: their blocks of code, run or read in one folder."""

import contextlib
import importlib
import importlib.util
import io
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml
from helpers.support import ROOT, configure, script
from hydra.core.override_parser.overrides_parser import OverridesParser

from gridworld.config.sweep import LAUNCHER_SCHEMAS, SweepConfig, TuneConfig
from gridworld.config.train import PICTURES
from gridworld.config.words import conf_folder

README = ROOT / "README.md"
PAGES = [README, *sorted(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts)]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
COMMANDS = ("python scripts/", "gridworld ")

_BLOCK = re.compile(
    r"^```(?:\{code-block\} )?(\w+)\n(?::caption: (\S+)\n\n)?(.*?)^```$", re.DOTALL | re.MULTILINE
)
_SEEDS = re.compile(r"seed=(?:range\(\d+\)|[\d,]+,\d+)$")
# Words that make a command short, where the page's claims need no more.
_FEW_STEPS = ["total_timesteps=1000", "evaluation.every=500"]
NO_PICTURES = [f"recording.{name}=false" for name in PICTURES]
_FEW_TRIALS = [
    *("tune.trials=2", "tune.seeds=1", "tune.final_seeds=1", "tune.confirm_seeds=2", "tune.workers=1")
]


@dataclass(frozen=True)
class Block:
    """A fenced block of code; with a caption it is a file of that name."""

    language: str
    file: str | None
    text: str
    is_next: bool  # there is nothing between it and the block before

    @property
    def lines(self) -> list[str]:
        """Its command lines, without comments and with continued lines in one."""
        whole = self.text.replace("\\\n", " ").splitlines()
        return [line.split("  #")[0].strip() for line in whole if line.strip()]


def blocks(page: Path, *languages: str) -> list[Block]:
    """The blocks of a page, in order; of some languages, or of all."""
    text, found, end = page.read_text("utf-8"), [], 0
    for match in _BLOCK.finditer(text):
        language, file, content = match.groups()
        found.append(Block(language, file or None, content, not text[end : match.start()].strip()))
        end = match.end()
    return [block for block in found if not languages or block.language in languages]


def module_of(name: str) -> Any:
    """A module of docs/."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def shortened(words: list[str]) -> list[str]:
    """The same command over fewer steps, seeds and trials."""
    program, *rest = words
    rest = [_SEEDS.sub("seed=0,1", word) for word in rest]
    if program == "tune.py" and "--config-dir" in rest:
        return [program, *rest, "--cfg"]  # reads the search space; another study searches
    if program == "tune.py":
        return [program, *_replaced(rest, [*_FEW_TRIALS, *_FEW_STEPS])]
    if program == "report.py":
        return [program, *rest, "--formats"]  # the page alone
    if program != "train.py":
        return [program, *rest]
    if any(word.startswith("resume=") for word in rest):
        return [program, *_replaced(rest, ["total_timesteps=10000"])]
    few = _FEW_STEPS[1:] if any(re.match(r"total_timesteps=.*,", word) for word in rest) else _FEW_STEPS
    looked_at = any(word.startswith("hydra.run.dir=") for word in rest)  # by another line
    return [program, *_replaced(rest, few if looked_at else [*few, *NO_PICTURES])]


def _replaced(words: list[str], others: list[str]) -> list[str]:
    keys = {other.partition("=")[0] for other in others}
    return [*(word for word in words if word.partition("=")[0] not in keys), *others]


class Reader:
    """Goes through pages in one empty folder, which looks like the repository from the inside.

    A line that was run in it before is not run again: a page may repeat what another has. `claims` has, by a
    part of a command line, what it prints and the words that are added to it; it is not shortened otherwise.
    """

    def __init__(self, folder: Path, claims: Mapping[str, tuple[str, list[str]]]) -> None:
        for name in ("scripts", "conf"):
            (folder / name).symlink_to(ROOT / name)
        (folder / "runs").mkdir()
        self.folder = folder
        self._claims = claims
        self._ran: set[str] = set()

    def read(self, page: Path) -> None:
        """Run a page's commands and Python, write its files, and read what else looks like a command.

        A block of text right after one of Python is what that prints.
        """
        names: dict[str, object] = {}
        printed = ""
        for block in blocks(page):
            if block.language == "text" and block.is_next and printed:
                assert block.text.split() == printed.split(), page
                printed = ""
                continue
            printed = ""
            if block.file:
                (self.folder / block.file).parent.mkdir(parents=True, exist_ok=True)
                (self.folder / block.file).write_text(block.text)
            elif block.language == "bash":
                for line in block.lines:
                    self._run_once(line)
            elif block.language == "python":
                with contextlib.redirect_stdout(io.StringIO()) as output:
                    exec(compile(block.text, page.name, "exec"), names)
                printed = output.getvalue()
            elif block.language == "yaml":
                yaml.safe_load(block.text)
            else:
                for line in block.lines:
                    check(line)

    def _run_once(self, line: str) -> None:
        again = line.split()[0] if line.startswith("tensorboard") else line
        if again in self._ran:
            return
        self._ran.add(again)
        if (
            line.startswith(("pip install ", "git clone ")) or "benchmark.py" in line
        ):  # commands/test_commands.py measures so
            check(line)
            return
        done = self._run(line)
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
        for claim, _ in self._claims_of(line):
            assert claim in done.stdout, done.stdout

    def _run(self, line: str) -> subprocess.CompletedProcess[str]:
        words = shlex.split(line)
        variables = dict(word.split("=", 1) for word in words if re.match(r"[A-Z_]+=", word))
        program, *words = words[len(variables) :]
        if program == "tensorboard":
            reads = str(Path(sys.executable).with_name(program))
            command = [reads, *words, "--inspect"]  # reads the same, and ends
            return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, timeout=300)
        assert program == "python"
        if words[0].startswith(("-I", "docs/")):  # by Python alone; not a command
            words = [str(ROOT / word) if word.startswith(("docs/", "scripts/")) else word for word in words]
            command = [sys.executable, *words]
            return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, timeout=300)
        words[0] = words[0].removeprefix("scripts/")
        claims = self._claims_of(line)
        words = [*words, *claims[0][1]] if claims else shortened(words)
        return script(*words, cwd=self.folder, timeout=300, **variables)

    def _claims_of(self, line: str) -> list[tuple[str, list[str]]]:
        return [claim for part, claim in self._claims.items() if part in line]


def check(line: str) -> None:
    """Read a line that a test cannot run (a cluster's, a window's) as its command would."""
    if line.startswith("pip install -e"):
        named = re.search(r"\.(?:\[([\w,]+)\])?", line)
        assert named
        assert set((named[1] or "test").split(",")) <= set(EXTRAS), line
    if not line.startswith(COMMANDS):
        return
    *_, name = line.split()[1].removesuffix(".py").split("/")
    words = shlex.split(line)[2:]
    if name in ("train", "tune"):
        _check_settings(words)
    elif words != ["--help"]:
        importlib.import_module(f"gridworld.commands.{name}")._parser().parse_args(words)


def _check_settings(words: list[str]) -> None:
    """Compose the settings; of a sweep the first job's."""
    launchers = {each.name: each for schema in LAUNCHER_SCHEMAS.values() for each in fields(schema)}
    known = {
        "hydra.launcher": set(launchers),
        "hydra.sweeper": {each.name for each in fields(SweepConfig)},
        "tune": {each.name for each in fields(TuneConfig)},
    }
    plain = []
    for override in OverridesParser.create().parse_overrides([word for word in words if "=" in word]):
        key, value = override.key_or_group, override.value()
        group, _, name = key.rpartition(".")
        if group in known:
            assert name in known[group], key
        elif key == "hydra/launcher":
            assert value in LAUNCHER_SCHEMAS
        elif key == "tune":
            assert (conf_folder() / "tune" / f"{value}.yaml").is_file()
        elif not key.startswith("hydra.") and key not in ("resume", "recipe"):
            swept = override.is_sweep_override() and "glob(" not in override.input_line
            first = next(override.sweep_string_iterator()) if swept else None
            plain.append(override.input_line if first is None else f"{key}={first}")
    configure(*(word for word in plain if "glob(" not in word))
