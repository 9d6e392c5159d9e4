"""The atlas of implementations: rows are complete, are not run again, and mean what is played."""

import importlib
import importlib.util
import itertools
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.support import ROOT
from scipy import stats

from gridworld.base.errors import InputError

ATLAS = ROOT / "docs" / "benchmarks" / "atlas"
MODULES = ("plan", "rows", "pages", "adapters")


@pytest.fixture
def atlas(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Any]:
    """The command, with its modules, whose names are theirs for a test only."""
    monkeypatch.syspath_prepend(ATLAS)
    monkeypatch.setenv("ATLAS_ROOM", str(tmp_path / "room"))
    spec = importlib.util.spec_from_file_location("atlas", ATLAS / "__main__.py")
    assert spec
    assert spec.loader
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.pages, module.adapters = map(importlib.import_module, ("pages", "adapters"))
    yield module
    for name in MODULES:
        del sys.modules[name]


def _rows(
    atlas: Any, library: str, steps: list[float], page: str = "implementations", world: str = "classic"
) -> list[Any]:
    """Rows of runs that are certified for good at these steps; infinity is never."""
    jobs = atlas.plan.jobs(page, [library], ["dqn"], [world], len(steps))
    made = []
    for job, since in zip(jobs, steps, strict=True):
        is_certified = np.isfinite(since)
        curve = f"0:0.9 {since:.0f}:0*" if is_certified else "0:0.9"
        end = (f"{since:.0f}", 0.0, "") if is_certified else ("", 0.9, "slow")
        made.append(atlas.rows.Row(*job.key, 30_000, 1000, 60.0, *end, curve))
    return made


def test_two_one_sided_tests_are_scipys(atlas: Any) -> None:
    rng = np.random.default_rng(0)
    one, other = np.exp(rng.normal(9, 0.3, 40)), np.exp(rng.normal(9.1, 0.2, 30))
    ratio, p = atlas.pages.equivalence(one, other)
    logs, margin = (np.log(one), np.log(other)), np.log(atlas.plan.MARGIN)
    sides = [
        stats.ttest_ind(logs[0] + margin, logs[1], equal_var=False, alternative="greater"),
        stats.ttest_ind(logs[0] - margin, logs[1], equal_var=False, alternative="less"),
    ]
    assert p == pytest.approx(max(side.pvalue for side in sides))
    bounds = stats.ttest_ind(*logs, equal_var=False).confidence_interval(0.9)
    assert np.log([ratio.low, ratio.high]) == pytest.approx([bounds.low, bounds.high])
    assert (p <= 0.05) == (ratio.low > 1 / atlas.plan.MARGIN and ratio.high < atlas.plan.MARGIN)


def test_verdicts(atlas: Any) -> None:
    base = [10_000.0 + 500 * seed for seed in range(12)]
    cases = {
        "the same curves": base,
        "equal": [steps + 100 for steps in base],
        "differ": [steps * 1.6 for steps in base],
        "undecided": [steps * (1.3 if seed % 2 else 0.7) for seed, steps in enumerate(base)],
        "too few seeds": [steps + 100 for steps in base[:9]],
    }
    for verdict, steps in cases.items():
        found = [*_rows(atlas, "sb3", base), *_rows(atlas, "engine", steps)]
        assert atlas.pages.compare(*atlas.pages.groups(found, "implementations")).verdict == verdict
    never = [*_rows(atlas, "sb3", base), *_rows(atlas, "engine", [np.inf] * 10 + base[:2])]
    pair = atlas.pages.compare(*atlas.pages.groups(never, "implementations"))
    assert (pair.verdict, pair.ratio, pair.p) == ("differ", None, None)
    assert pair.improvement.point > 0.8


def test_a_page_says_how_little_it_knows(atlas: Any, tmp_path: Path) -> None:
    for name in ("reference", "data"):
        (tmp_path / name).mkdir()
    for page in ("implementations", "defaults"):
        shutil.copy(ROOT / "docs" / "reference" / f"{page}.md", tmp_path / "reference")
    found = [
        *_rows(atlas, "sb3", [9000.0, np.inf, 12_000.0]),
        *_rows(atlas, "engine", [9000.0, 10_000.0, 12_000.0]),
    ]
    atlas.pages.draw(found, tmp_path)
    text = (tmp_path / "reference" / "implementations.md").read_text("utf-8")
    assert "**3 seeds: a smoke test, no claim.**" in text
    assert "| dqn | classic | sb3 | 2 of 3 (21% to 94%) | 12k (9k to never)" in text
    assert "| sb3 : engine | too few seeds | 2 of 3 |" in text
    assert "<svg" in (tmp_path / "data" / "atlas_dqn.svg").read_text("utf-8")
    atlas.pages.draw(found, tmp_path)
    assert (tmp_path / "reference" / "implementations.md").read_text("utf-8") == text
    old = [row._replace(digest="of other settings") for row in found]
    assert atlas.pages.groups(old, "implementations") == []


def test_defaults_have_their_causes_and_worlds(atlas: Any, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    found = _rows(atlas, "sb3", [9000.0, np.inf, np.inf], "defaults")
    found += _rows(atlas, "sb3", [9000.0, 9000.0, np.inf], "defaults", "map_4_0_slip")
    blocks = atlas.pages._defaults(atlas.pages.groups(found, "defaults"), tmp_path / "data")
    assert "| sb3 | dqn | 2 | 6 | 3 of 6 (19% to 81%) |" in blocks["results"]
    assert blocks["results"].endswith("| 60 s | slow 3 |")
    assert "| classic | no | 30 | 8.0 | 1 of 3 (6% to 79%) |" in blocks["worlds"]
    assert "| map_4_0_slip | yes | 16 |" in blocks["worlds"]
    assert len(atlas.plan.worlds_of("defaults")) == 40


@pytest.mark.slow
def test_the_pages_are_what_their_rows_give(atlas: Any, tmp_path: Path) -> None:
    for name in ("reference", "data"):
        (tmp_path / name).mkdir()
    names = [f"reference/{page}.md" for page in ("implementations", "defaults")]
    for name in names:
        shutil.copy(ROOT / "docs" / name, tmp_path / name)
    atlas.pages.draw(atlas.rows.read(atlas.rows.ROWS), tmp_path)
    for name in names:
        assert (tmp_path / name).read_text("utf-8") == (ROOT / "docs" / name).read_text("utf-8")


@pytest.mark.parametrize("name", ["classic", "frozen_lake", "river_swim"])
def test_workers_step_as_the_world_does(atlas: Any, name: str) -> None:
    """The mean of many steps from every state is what the tables say; the clock reads every N steps."""
    [world] = [each for each in atlas.plan.worlds_of("implementations") if each.name == name]
    tables = json.loads(world.tables)
    lines: list[dict[str, Any]] = []
    reader = atlas.adapters.Reader({"every": 7, "steps": 50, "seeds": [0], "world": tables}, None)
    reader.write = lambda **line: lines.append(line)
    reader.greedy = lambda rows: rows.argmax(axis=1)
    env = atlas.adapters.TableEnv(tables, reader)
    env.reset(seed=0)
    mdp = world.mdp
    for state, action in itertools.product(np.flatnonzero(~mdp.terminal), range(mdp.num_actions)):
        counts = np.zeros(mdp.num_states)
        for _ in range(200):
            env._state = int(state)
            observation, _, terminated, _, _ = env.step(action)
            counts[env._state] += 1
            assert (observation == reader.rows[env._state]).all()
            assert terminated == mdp.terminal[env._state]
        expected = np.zeros(mdp.num_states)
        np.add.at(expected, mdp.next_state[state, action], mdp.probability[state, action])
        assert np.abs(counts / 200 - expected).max() < 0.2
    assert [line["step"] for line in lines] == [0, 7, 14, 21, 28, 35, 42, 49]


def test_bad_input_is_a_sentence(atlas: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^--worlds moon: must be among classic, "):
        atlas.main(["implementations", "sb3", "--worlds", "moon"])
    with pytest.raises(InputError, match=r"^rejax: must be among sb3, "):
        atlas.main(["implementations", "rejax"])
    with pytest.raises(
        InputError, match=r"^sbx: is not installed; run python docs/benchmarks/atlas install sbx$"
    ):
        atlas.main(["implementations", "sbx"])
    path = tmp_path / "rows.csv"
    atlas.rows.append(path, _rows(atlas, "sb3", [9000.0])[0])
    path.write_text(path.read_text("utf-8") + "implementations,sb3,dq\n")
    with pytest.raises(InputError, match=r"rows.csv: has other columns or half a line; delete that line$"):
        atlas.rows.read(path)


@pytest.mark.slow
def test_stable_baselines3_and_the_engine(
    atlas: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(atlas.plan.LENGTHS, "dqn", (2500, 1000))
    path = tmp_path / "rows.csv"
    words = ["--rows", str(path), "implementations", "sb3", "engine", "--algorithms", "dqn"]
    words += ["--worlds", "frozen_lake", "--seeds", "3"]
    atlas.main(words)
    found = atlas.rows.read(path)
    assert {(row.library, row.seed) for row in found} == set(itertools.product(["sb3", "engine"], "012"))
    [world] = [each for each in atlas.plan.worlds_of("implementations") if each.name == "frozen_lake"]
    for row in found:
        assert (row.done, row.every) == (2500, 1000)
        steps, regrets = row.points()
        assert steps.tolist() == [0, 1000, 2000, 2500]
        assert regrets[-1] == row.regret
        assert ((regrets >= 0) & (regrets <= atlas.plan.evaluator(world, 0.9).optimal_value + 1e-9)).all()
        assert "torch" in row.versions
    before, _ = path.read_bytes(), capsys.readouterr()
    atlas.main([*words, "--estimate"])
    assert capsys.readouterr().out.startswith("0 rows to run")
    atlas.main(words)  # runs nothing again
    assert (capsys.readouterr().out, path.read_bytes()) == ("", before)
    path.write_bytes(b"".join(before.splitlines(keepends=True)[:-1]))  # as if it was stopped
    atlas.main(words)
    again = atlas.rows.read(path)
    assert [row._replace(seconds=0) for row in again] == [row._replace(seconds=0) for row in found]
    capsys.readouterr()
    atlas.main(["--rows", str(path), "repeat", "--seeds", "1"])
    assert capsys.readouterr().out.count(": the same\n") == 1


@pytest.mark.slow
def test_a_saved_model_plays_as_its_exact_score_says(atlas: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """In FrozenLake-v1 as Gymnasium has it, which knows nothing of the tables."""
    atlas.main(["check", "sb3", "--algorithms", "ppo"])
    assert capsys.readouterr().out.startswith("sb3 ppo: exact 0.")
