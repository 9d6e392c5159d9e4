"""Run folders that look like real ones, written in a moment: real settings, made-up curves."""

import csv
import dataclasses
import hashlib
import json
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from helpers.support import configure

from gridworld.base.safe_read import sealed, sha256
from gridworld.config.train import TrainConfig
from gridworld.report import tuning_study as tuning
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import read_run
from gridworld.sweeps.folder import SweepFolder
from gridworld.sweeps.plan import Job
from gridworld.sweeps.tune.study import SEARCH_JSON
from gridworld.world.evaluation import Evaluator

_COLUMNS = ("value", "regret", "certified", "goal_probability", "trap_probability", "timeout_probability")
_COLUMNS += ("return", "length")


class Maker:
    """Writes runs of one configuration; the world is solved once."""

    def __init__(self, *overrides: str) -> None:
        config = configure(*overrides)
        self.config = dataclasses.asdict(config)
        mdp = config.env.compile()
        self.evaluator = Evaluator(mdp, config.evaluation.gamma, config.env.max_episode_steps)
        self.layout = mdp.layout

    def write(
        self,
        folder: Path,
        seed: int,
        certified_at: float = math.inf,
        online: Sequence[float | None] | None = None,
        regret: float | None = None,
        evaluations: int = 21,
        **settings: Any,
    ) -> Path:
        """A run that stands still until it is certified; `settings` replace some by their dotted names."""
        config = json.loads(json.dumps(self.config)) | {"seed": seed}
        for name, value in settings.items():
            *path, last = name.replace("__", ".").split(".")
            section = config
            for part in path:
                section = section[part]
            section[last] = value
        best = self.evaluator.optimal_value
        lazy = best if regret is None else regret
        rows = []
        for index in range(evaluations):
            step = index * 1000
            done = step >= certified_at
            scores = (best if done else best - lazy, 0.0 if done else lazy, int(done), float(done))
            numbers = (*scores, 0.0, float(not done), float(done), 8.0 if done else 100.0)
            row: dict[str, Any] = {"step": step}
            row |= dict(zip(_COLUMNS, numbers, strict=True))
            row |= {f"sampled_{name}": value for name, value in zip(_COLUMNS, numbers, strict=True)}
            if online is not None:
                row["online_return"] = "" if online[index] is None else online[index]
            rows.append(row)
        self._files(folder, config, rows, seed)
        return folder

    def _files(self, folder: Path, config: dict[str, Any], rows: list[dict[str, Any]], seed: int) -> None:
        folder.mkdir(parents=True)
        with (folder / "curve.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        last = rows[-1]
        first = next((row["step"] for row in rows if row["certified"]), None)
        summary = {
            "agent": config["agent"]["name"],
            "env": self.layout.name,
            "seed": seed,
            "gamma": config["evaluation"]["gamma"],
            "timesteps": last["step"],
            "certified": bool(last["certified"]),
            "best_step": last["step"],
            "first_certified_step": first,
            "certified_since_step": first,  # for good
            "optimal_value": self.evaluator.optimal_value,
            "regret": last["regret"],
            "train_seconds": 1.5,
        }
        manifest = {
            "status": "finished",
            "started": "2026-01-02T03:04:05.000+00:00",
            "versions": {"gridworld": "0.1.0"},
            "layout": self.layout.text().split("\n"),
            "config": config,
        }
        (folder / "summary.json").write_text(json.dumps(summary))
        files = ("curve.csv", "summary.json")
        sums = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in files}
        (folder / "manifest.json").write_text(json.dumps(sealed(manifest | {"sha256": sums})))


def sweep(folder: Path, seeds: int = 20) -> Path:
    """A study: three agents on three tasks; on the cliff, two of them with online returns."""
    rng = np.random.default_rng(1)
    for env in ("classic", "four_rooms"):
        maker = Maker("agent=ppo", f"env={env}")
        for name, typical, lost in (("ppo", 6000, 0.1), ("dqn", 3000, 0.0), ("a2c", 9000, 0.6)):
            for seed in range(seeds):
                step = rng.gamma(4, typical / 4) if rng.random() >= lost else math.inf
                maker.write(folder / f"{name},{env},{seed}", seed, step, agent__name=name)
    maker = Maker("agent=ppo", "env=cliff")
    for name, level, regret in (("q_learning", -45.0, 0.0), ("sarsa", -25.0, 3.2)):
        for seed in range(seeds):
            noise = rng.normal(0, 4, 21)
            online = [None, *(level - 60 * 0.6**i + noise[i] for i in range(1, 21))]
            at = 4000 + 1000 * int(rng.integers(3)) if regret == 0 else math.inf
            maker.write(folder / f"{name},cliff,{seed}", seed, at, online, regret or 70.0, agent__name=name)
    return folder


def write_sweep(folder: Path, run: Path) -> None:
    """Of three jobs: one is done, by a copy of the run, one failed before it began, one is to be run."""
    sweep = SweepFolder(folder)
    manifest = read_run(run).manifest
    digest = settings_hash(manifest["config"], "\n".join(manifest["layout"]))
    hashes = {"seed=0": digest, "seed=1": "1" * 32, "seed=2": "2" * 32}
    jobs = [Job((job,), (job,), hashes[job], None, TrainConfig()) for job in hashes]
    with sweep.at_work():
        sweep.add(jobs, ["seed=0,1,2"])
    shutil.copytree(run, folder / "seed=0")
    (folder / "seed=1").mkdir()
    (folder / "seed=1" / "error.txt").write_text("agent.learning_rate=12: must be less than 10\n")
    sweep.write(sweep.rows())


def write_study(folder: Path) -> None:
    """A search of five trials that came to its end."""
    folder.mkdir()
    trials = "trial,status,score,certified,steps,regret,seconds,repeats,worker,error,agent.gamma\n"
    trials += "".join(f"{n},done,0.{n}5,1/2,120,0.5,1.25,,host:1,,0.9{n}\n" for n in range(1, 6))
    (folder / tuning.TRIALS_CSV).write_text(trials)
    study = {
        "study": "mine", "agent": "dqn", "env": "classic", "confirmation": {"sentence": "19 of 20 were."},
        "winner": {"trial": 1, "score": 0.15, "values": {"agent.gamma": 0.91}}, "began_from": None,
        "finalists": [{"trial": 1, "score": 0.15, "certified": 2, "seeds": 3}],
        "importances": {"agent.gamma": 0.75},
        "space": {"agent.gamma": {"type": "float", "low": 0.5, "high": 0.99, "log": False}},
        tuning.TRIALS_SUM: sha256(trials.encode()),
    }  # fmt: skip
    (folder / tuning.STUDY_JSON).write_text(json.dumps(sealed(study)))
    (folder / SEARCH_JSON).write_text(
        json.dumps(sealed({"study": "mine", "about": {"objective": {"n": 20}}}))
    )
