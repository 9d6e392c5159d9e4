"""Made-up maps, settings, manifests and model files, each from a seed; and what a program makes of one."""

import contextlib
import hashlib
import io
import json
import math
import random
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from helpers.forks import megabytes
from helpers.hostile import damaged, seal
from helpers.support import SHORT, configure
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gridworld.base.errors import InputError
from gridworld.base.safe_read import sealed
from gridworld.commands import jobs as jobs_command
from gridworld.config.compose import to_config
from gridworld.report.evidence import read
from gridworld.report.setting_charts import tuning_charts
from gridworld.report.tables import to_captioned_markdown, to_csv, tuning_tables
from gridworld.report.tuning_study import TRIALS_SUM, find_tunings
from gridworld.sweeps.tune.study import is_claimed
from gridworld.training.saved_run import SavedRun
from gridworld.training.setup import check_settings, make_context
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load

OURS = (InputError, OmegaConfBaseException)  # both end as one sentence with exit code 2
Target = Callable[[random.Random, Path], None]
AGENTS = ("a2c", "dqn", "sarsa")  # whose good runs there are

# Odd values of every type. What is large is so large that no machine has room for it, or small enough.
# fmt: off
ODD: list[Any] = [
    None, True, False, -1, 0, 1, 2, 3, 7, 100, -(10**12), 10**12, 10**18, 10**30,
    0.0, 0.5, -0.5, 1.5, 1e-300, 1e300, math.nan, math.inf, -math.inf,
    "", " ", "abc", "classic", "cliff", "nowhere.txt", "../../x", "/dev/zero", "/etc", "\x00", "\x1b[2J",
    "\ud800",
    "lin_0.1", "lin_-1", "lin_nan", "lin_", "1e400", "${seed}", "${oc.env:HOME}", "${", "???", "x" * 10_000,
    "torch.nn.ReLU", "os.system", "stable_baselines3.PPO", "stable_baselines3", "..", "a.b", "MlpPolicy",
    [], [64, 64], [0], [10**12], ["a"], [[1]], {}, {"a": 1}, {"pi": [8], "vf": [8]}, {1: 2},
]
# fmt: on


def fuzz_map(random: random.Random, folder: Path) -> None:
    """A file that may be a map, and its world solved if it is."""
    kind = random.choice(["tiles", "tiles", "tiles", "damaged", "bytes", "text", "long"])
    rows, cols = random.randint(1, 12), random.randint(1, 12)
    lines = ["".join(random.choices("SGT#.", (1, 1, 1, 2, 10), k=cols)) for _ in range(rows)]
    text = "\n".join(lines)
    if kind == "damaged":
        place = random.randrange(len(text))
        odd = random.choice(["x", "\n", "\t", "é", "\x00", "\r", "\u2028", "s", ""])
        text = f"{text[:place]}{odd}{text[place + 1 :]}"
    elif kind == "text":
        text = "".join(chr(random.randrange(1, 0xD000)) for _ in range(random.randint(0, 300)))
    elif kind == "long":
        text = random.choice("SG.#\n ") * random.choice([10**3, 10**5, 2 * 10**6])
    raw = random.randbytes(random.randint(0, 400)) if kind == "bytes" else text.encode("utf-8", "replace")
    file = folder / "map.txt"
    file.write_bytes(raw)
    layout = load(str(file))
    slip = random.choice([0, 0.2, 1])
    Evaluator(compile_mdp(layout, slip=slip), random.choice([0, 0.9, 0.99]), random.randint(1, 300))


def fuzz_config(random: random.Random, folder: Path) -> None:
    """Settings of an agent with a few odd values, as far as training would take them before it begins."""
    agent = random.choice(sorted(SHORT))
    settings = OmegaConf.structured(configure(*SHORT[agent]))
    content = OmegaConf.to_container(settings)
    assert isinstance(content, dict)
    for _ in range(random.randint(1, 3)):
        spoil(random, content)
    content.pop("device", None)  # asks the machine, not us
    merged = OmegaConf.merge(settings, OmegaConf.create(content))
    config = to_config(merged)  # type: ignore[arg-type]
    mdp = check_settings(config)
    Evaluator(mdp, config.evaluation.gamma, config.env.max_episode_steps)
    config.agent.build(make_context(config, mdp))


def spoil(random: random.Random, content: dict[Any, Any]) -> None:
    """Change, add or take away one thing somewhere in it."""
    while True:
        key = random.choice(sorted(content, key=str)) if content else "new"
        inner = content.get(key)
        if not (isinstance(inner, dict) and inner and random.random() < 0.9):
            break
        content = inner
    action = random.random()
    if action < 0.05:
        content.pop(key, None)
    elif action < 0.1:
        content[random.choice(["_target_", "new", "x y", ""])] = random.choice(ODD)
    else:
        content[key] = random.choice(ODD)


def fuzz_manifest(random: random.Random, folder: Path) -> None:
    """A run's folder whose manifest, summary or curve was changed, by meaning or by bytes."""
    run = fresh_copy(folder, random.choice(AGENTS))
    name = random.choice(["manifest.json", "manifest.json", "manifest.json", "summary.json", "curve.csv"])
    raw = (run / name).read_bytes()
    if name.endswith(".json") and random.random() < 0.7:
        content = json.loads(raw)
        for _ in range(random.randint(1, 3)):
            spoil(random, content.get("config", content) if random.random() < 0.7 else content)
        if name == "manifest.json":
            with contextlib.suppress(TypeError):  # keys that do not go together
                content = sealed(content)
        raw = json.dumps(content, skipkeys=True).encode("utf-8", "surrogatepass")
    else:
        raw = damaged(random, raw)
    (run / name).write_bytes(raw)
    if name != "manifest.json":
        seal(run, name)
    assert read(run) is not None  # a report names what is wrong and goes on
    saved = SavedRun(run)
    saved.evaluator().score(saved.snapshot().sampled)


def fuzz_model(random: random.Random, folder: Path) -> None:
    """A model file with changed bytes, whose checksum was made to fit."""
    run = fresh_copy(folder, random.choice(AGENTS))
    seal(run, "model.zip", damaged(random, (run / "model.zip").read_bytes()))
    snapshot = SavedRun(run).snapshot()
    assert all(math.isfinite(value) for value in snapshot.values)


def fuzz_sweep(random: random.Random, folder: Path) -> None:
    """A sweep's folder with something changed, by meaning or by bytes, as jobs.py lists it."""
    sweep = fresh_copy(folder, "sweep")
    names = ["sweep.json", "sweep.json", "jobs.csv", "seed=0/manifest.json", "seed=0/summary.json"]
    change(random, sweep / random.choice(names))
    with contextlib.redirect_stdout(io.StringIO()) as told:
        jobs_command.main([str(sweep)])
    assert told.getvalue().replace("\n", "").isprintable()


def fuzz_study(random: random.Random, folder: Path) -> None:
    """A study's folder with something changed, as a report shows it."""
    study = fresh_copy(folder, "study")
    change(random, study / random.choice(["study.json", "study.json", "trials.csv", "search.json"]))
    is_claimed(study, "mine")
    found, problems = find_tunings([study])
    for each in found:
        for table in tuning_tables(each):
            to_csv(table), to_captioned_markdown(table)
        for chart in tuning_charts(each):
            places = "".join(re.findall(r'\b(?:d|x|y|transform)="[^"]*"', chart.saved_as("svg").decode()))
            assert not re.search(r"\b(nan|inf)\b", places)
    if problems:
        raise InputError(problems[0])


def change(random: random.Random, path: Path) -> None:
    """By meaning, and mostly sealed again, or by bytes."""
    raw = path.read_bytes()
    if path.suffix == ".json" and random.random() < 0.8:
        content = json.loads(raw)
        for _ in range(random.randint(1, 2)):
            spoil(random, content)
        with contextlib.suppress(TypeError):  # keys that do not go together
            content = sealed(content) if random.random() < 0.9 else content
        path.write_bytes(json.dumps(content, skipkeys=True).encode("utf-8", "surrogatepass"))
    else:
        path.write_bytes(damaged(random, raw))
    name, study = path.name, path.with_name("study.json")
    if name == "trials.csv" and random.random() < 0.8:
        content = json.loads(study.read_bytes()) | {TRIALS_SUM: hashlib.sha256(path.read_bytes()).hexdigest()}
        study.write_text(json.dumps(sealed(content)))
    if name == "summary.json":
        seal(path.parent, name)


def fresh_copy(folder: Path, name: str) -> Path:
    """Of the good sweep, study, or run of an agent."""
    copy = folder / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    return shutil.copytree(folder / f"good-{name}", copy)


TARGETS: dict[str, Target] = {
    "map": fuzz_map,
    "config": fuzz_config,
    "manifest": fuzz_manifest,
    "model": fuzz_model,
    "sweep": fuzz_sweep,
    "study": fuzz_study,
}


def attempt(name: str, seed: int, folder: Path) -> tuple[str, float, float]:
    """How the example ended ("accepted", "refused" or a foreign exception), seconds, megabytes at most."""
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    before, started = megabytes("VmRSS"), time.process_time()
    try:
        TARGETS[name](random.Random(f"{name} {seed}"), folder)
        outcome = "accepted"
    except OURS:
        outcome = "refused"
    except Exception as error:
        place = error.__traceback__
        while place is not None and place.tb_next is not None:
            place = place.tb_next
        where = "" if place is None else f"{place.tb_frame.f_code.co_filename}:{place.tb_lineno}"
        outcome = f"{type(error).__name__}: {error} ({where})"
    return outcome, time.process_time() - started, megabytes("VmHWM") - before
