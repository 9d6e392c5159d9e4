"""A mistake on a command line gets one sentence, exit code 2, no traceback, and leaves nothing behind.

The command lines and their sentences are in `bad_input.txt`.
"""

import json
import os
import warnings
from pathlib import Path

import pytest
from helpers.support import NO_FILES, ROOT, SHORT, configure, script, train_in

from gridworld.errors import InputError
from gridworld.storage.safe_read import sealed
from gridworld.training.train import train

YAMLS: dict[str, bytes] = {
    "agent/broken.yaml": b"a: [1\nb: 2\n",
    "agent/empty.yaml": b"",
    "agent/binary.yaml": b"\xff\xfe",
    "agent/endless.yaml": b"a: &a [*a]\n",
    "agent/mine.yaml": b"# @package _global_\ndefaults:\n  - /agent/schema/sb3@agent\n  - _self_\n"
    b"agent: {name: mine, algorithm: own_module.Mine}\n",
    "env/tagged.yaml": b"layout: !!python/object/apply:os.system [ls]\n",
    "env/misspelt.yaml": b"layuot: cliff\n",
    "own_module.py": b"1 / 0\n",
    "needy.py": b"import not_installed\n",
}

MAPS = {
    "unknown": "S.x\n..G\n",
    "ragged": "S..\n.G\n",
    "no_start": "...\n..G\n",
    "no_goal": "S..\n...\n",
    "empty": "",
    "enclosed": "S#G\n.#.\n",
}


def table(title: str) -> list[tuple[str, str]]:
    """(command line, a part of the sentence that refuses it) of the section with this title."""
    text = Path(__file__).with_name("bad_input.txt").read_text("utf-8")
    section = next(part for part in text.split("\n\n") if part.startswith(f"# {title}:"))
    return [(line, words) for line, _, words in (row.partition("  =>  ") for row in section.splitlines()[1:])]


# In a process each; the others are in forks of one, see `script`.
REAL = (*("env.layout={maps}/ragged.txt", "--config-dir {conf} agent=mine"),)


OUT_OF_SIZE = "must be 0, or from"
# (settings, words of the sentence): of the right type, and beyond what any number here holds
ABSURD = [
    *(
        (f"agent={agent} env.{name}={value}", f"{name}={float(value)}: {OUT_OF_SIZE} {bounds}")
        for agent, least, most, cut in (("q_learning", 1e-100, 1e100, 1), ("dqn", 1e-30, 1e15, 100))
        for name, times in (("step_reward", cut), ("goal_reward", 1), ("trap_reward", 1))
        for value in ("1e307", "-1e307", "1e-320")
        for bounds in [f"{least:g} to {most / times:g}"]
    ),
    ("agent=a2c env.goal_reward=1e20", f"env.goal_reward=1e+20: {OUT_OF_SIZE} 1e-30 to 1e+15"),
    ("agent=q_learning agent.initial_value=1e307", f"agent.initial_value=1e+307: {OUT_OF_SIZE}"),
    (f"agent.learning_rate={10**400}", "must be a number of at least 0, or lin_NUMBER"),
    (f"agent.stats_window_size={10**30}", "must be from 1 to 1000000000"),
    (f"agent=sarsa agent.stats_window_size={10**30}", "must be from 1 to 1000000000"),
    (f"agent.n_steps={10**30}", "must be from 1 to 100000"),
    (f"agent.train_freq={10**30}", "must be from 1 to 100000"),
    (f"agent=qrdqn +agent.arguments.train_freq={10**30}", "must be from 1 to 100000"),
    ("agent=qrdqn +agent.arguments.tau=1e307", "agent.arguments.tau=1e+307: must be from 0 to 1"),
    ("agent=ppo agent.clip_range=1e307", "agent.clip_range=1e+307: must be from 0 to 1000000000000000"),
    (
        "agent=ppo agent.clip_range_vf=lin_1e307",
        "clip_range_vf=lin_1e307: must be from 0 to 1000000000000000",
    ),
    (f"agent=ppo agent.stats_window_size={10**400}", "must be from 1 to 1000000000"),
]


def test_an_absurd_number_is_refused_before_it_is_used(tmp_path: Path) -> None:
    for line, words in ABSURD:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises(InputError) as mistake:
                train(configure(*line.split()), tmp_path, [])
        assert words in str(mistake.value), line
    assert list(tmp_path.iterdir()) == []


def test_the_largest_rewards_are_calculated_with_without_an_overflow(tmp_path: Path) -> None:
    """The smallest, too: they are no nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for agent, size in (("q_learning", 1e100), ("q_learning", 1e-100), ("ppo", 1e15), ("ppo", 1e-30)):
            step = f"env.step_reward={-size / 100 if size > 1 else 0}"
            rewards = [f"env.goal_reward={size}", f"env.trap_reward={-size}", step]
            summary = train_in(tmp_path / f"{agent} {size}", *SHORT[agent], *rewards, *NO_FILES)
            assert summary["optimal_goal_probability"] == 1


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    for name, text in MAPS.items():
        (folder / f"{name}.txt").write_text(text)
    (folder / "binary.txt").write_bytes(bytes(range(128, 256)))
    (folder / "large.txt").write_text(("." * 1000 + "\n") * 300)
    return folder


@pytest.fixture(scope="module")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Yaml files and modules of a user's own, each with a mistake."""
    folder = tmp_path_factory.mktemp("conf")
    for name, content in YAMLS.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize(("line", "words"), table("train.py"), ids=lambda value: str(value)[:60])
def test_train_refuses_before_it_writes(
    line: str, words: str, maps: Path, conf: Path, tmp_path: Path
) -> None:
    path = f"{conf}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    words_given = line.replace("{maps}", str(maps)).replace("{conf}", str(conf)).split()
    done = script("train.py", *words_given, cwd=tmp_path, real=line in REAL, PYTHONPATH=path)
    sentence = done.stderr.strip().splitlines()[-1]
    assert words in sentence
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_folder_that_cannot_be_a_runs_is_refused_and_left_alone(tmp_path: Path) -> None:
    for name, content in (("file", ""), ("sweep/sweep.json", "{}"), ("used/checkpoints/1000.state", "")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    manifest = sealed({"status": "finished", "config": {}, "layout": []})
    (tmp_path / "used" / "manifest.json").write_text(json.dumps(manifest))
    before = sorted(tmp_path.rglob("*"))
    longer = f"make that run longer with python {ROOT}/scripts/train.py resume=used total_timesteps=..."
    for folder, told in (
        ("used", f"used: contains a run already; choose another folder, or {longer}"),
        ("file/run", "file/run: cannot be made, file is a file; choose another hydra.run.dir"),
        ("sweep", "sweep: is the folder of a sweep; choose another hydra.run.dir"),
    ):
        done = script("train.py", f"hydra.run.dir={folder}", cwd=tmp_path)
        assert (done.returncode, done.stdout, done.stderr) == (2, "", f"error: {told}\n")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("line", "words"), table("train.py -m"))
def test_a_sweep_is_refused_before_it_writes(line: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "manifest.json").write_text("{}")
    done = script("train.py", "-m", *line.split(), cwd=tmp_path)
    assert words in done.stderr.strip().splitlines()[-1]
    assert (done.returncode, done.stdout) == (2, "")
    assert "Traceback" not in done.stderr
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["manifest.json"]


@pytest.mark.parametrize(
    ("launcher", "package", "extra"),
    [("slurm", "submitit", "slurm"), ("ray", "ray", "ray")],
)
def test_a_launcher_that_is_not_installed_names_its_extra(
    launcher: str, package: str, extra: str, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(f"import sys; sys.modules['{package}'] = None\n")
    path = f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    line = ["-m", "seed=0,1", f"hydra/launcher={launcher}"]
    done = script("train.py", *line, cwd=tmp_path, real=True, PYTHONPATH=path)
    assert done.returncode == 2
    assert done.stderr == (
        f"error: hydra/launcher={launcher}: {package} is not installed; pip install -e '{ROOT}[{extra}]'\n"
    )


def test_slurm_is_started_where_it_is(tmp_path: Path) -> None:
    done = script("train.py", "-m", "seed=0,1", "hydra/launcher=slurm", cwd=tmp_path, PATH=str(tmp_path))
    assert done.returncode == 2
    assert done.stderr.startswith("error: hydra/launcher=slurm: there is no sbatch on this machine; start")


def test_divergence_is_told_and_marked(tmp_path: Path) -> None:
    done = script("train.py", "agent.learning_rate=1e30", "hydra.run.dir=run", cwd=tmp_path)
    assert done.returncode == 2
    assert "training diverged" in done.stderr
    assert '"status": "failed"' in (tmp_path / "run" / "manifest.json").read_text()


@pytest.mark.parametrize(("line", "words"), table("the other scripts"))
def test_the_other_scripts_refuse_too(line: str, words: str, tmp_path: Path) -> None:
    done = script(*line.split(), cwd=tmp_path, SDL_VIDEODRIVER="", DISPLAY="", WAYLAND_DISPLAY="")
    assert words in done.stderr.strip().splitlines()[-1]
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
