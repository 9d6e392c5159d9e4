"""Where a run can be exported to, a row each: add a function that writes it, and its row in `TARGETS`.

Unless the variables of W&B or MLflow say otherwise, all stays in a local folder, and nothing is reported to
their makers. The metadata of the Hub's model card are laid out as huggingface_sb3 and RL Zoo write them
(https://huggingface.co/docs/hub/model-cards); names out of a run have the signs of a file's name or of an
import path.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from gridworld.base.atomic_write import remove_path, replacing_folder, write_bytes, write_json, write_text
from gridworld.base.errors import InputError, install_command
from gridworld.base.safe_read import read_object
from gridworld.config.worlds import EnvConfig, MapConfig
from gridworld.envs.registration import ENV_ID
from gridworld.report.export.exported_run import ExportedRun
from gridworld.report.tables import Table, to_markdown
from gridworld.run.folder import WORLD
from gridworld.world.metrics import METRICS
from gridworld.world.sources.arrays import world_bytes
from gridworld.world.sources.storm import drn_lines

# What W&B would note of the process that exports would read as if it were of the run.
_UNSAID = [
    *("disable_git", "disable_job_creation", "silent"),
    *("x_disable_stats", "x_disable_meta", "x_disable_machine_info"),
]
_WANDB: dict[str, Any] = {
    **dict.fromkeys(_UNSAID, True),
    **dict.fromkeys(["x_save_requirements", "save_code"], False),
    "host": "",
    "console": "off",
}
_MLFLOW_UI = "pip install mlflow && mlflow ui --backend-store-uri {place}"  # mlflow-skinny has no pages
_SQLITE = "sqlite:///"
_MLFLOWS_MOST = {"metrics": 1000, "params": 100}  # at a time
_LONGEST_PARAM = 6000  # characters
_RESULTS = "results.json"
_WHOLE = "exported"  # a file that W&B's folder of a run has once all is in it
_SHOWN = ("mean_reward", "success_rate", "mean_ep_length", "value", "regret")  # SB3's names before ours
_WORLD = ("slip", "step_reward", "goal_reward", "trap_reward", "max_episode_steps")
_CARD = """\
# {group}

{verdict}, after {steps:,} steps of training with seed {seed}. The world is small enough to be solved, so
these scores are exact, of the greedy policy and of the one that it explores with: no episode was sampled.

{scores}
{images}
## Use

```bash
pip install huggingface_hub  # and gridworld, from its repository
```

```python
from pathlib import Path

import gridworld
import gymnasium as gym
from huggingface_hub import snapshot_download
{the_import}

folder = Path(snapshot_download("USER/{group}"))
{world}
{load}
print(gridworld.evaluate({policy}, env=env, gamma={gamma}))
```

`config.json` has all settings, `results.json` all scores.

## Upload

```bash
hf auth login
hf upload USER/{group} .
```
"""


def to_wandb(run: ExportedRun, out: Path, project: str) -> str:
    """Write a run of W&B, offline unless WANDB_MODE says otherwise; returns its folder or address."""
    os.environ.setdefault("WANDB_MODE", "offline")
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
    for there in sorted(out.glob(f"wandb/offline-run-*-{run.identity}")):
        if (there / _WHOLE).exists():
            return str(there)
        remove_path(there)  # of an export that was killed
    import wandb

    def media(path: Path) -> Any:
        is_still = path.suffix == ".png"
        return wandb.Image(str(path)) if is_still else wandb.Video(str(path), format=path.suffix[1:])

    about: dict[str, Any] = {"project": project, "name": run.name, "group": run.group, "id": run.identity}
    where = {"dir": out.absolute(), "settings": wandb.Settings(**_WANDB)}
    with wandb.init(**about, **where, config=run.settings) as written:
        for step, numbers in run.curve:
            written.log(numbers, step=step)
        written.log({f"pictures/{path.name}": media(path) for path in run.pictures}, step=run.evidence.steps)
        written.summary.update(run.summary)
        artifact = wandb.Artifact(run.name, type="model")
        for path in run.models:  # beside the run, where `wandb sync` finds them
            copy = Path(written.dir) / path.name
            copy.write_bytes(path.read_bytes())
            artifact.add_file(str(copy), policy="immutable", skip_cache=True)
        written.log_artifact(artifact)
    here = out / "wandb" / Path(written.dir).parent.name
    write_text(here / _WHOLE, "")
    return str(written.url if os.environ["WANDB_MODE"] == "online" else here)


def to_mlflow(run: ExportedRun, out: Path, project: str) -> str:
    """Write a run of MLflow to a database, or to where MLFLOW_TRACKING_URI says; returns the URI."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    from mlflow import MlflowClient
    from mlflow.entities import Metric, Param

    logging.getLogger("mlflow").setLevel(logging.WARNING)  # it tells how it makes its tables
    server = os.environ.get("MLFLOW_TRACKING_URI")
    uri = server or f"{_SQLITE}{(out / 'mlflow.db').absolute().as_posix()}"
    database = Path(uri.removeprefix(_SQLITE))
    if uri.startswith(_SQLITE) and not database.exists():  # MLflow cannot use tables that are half made
        with TemporaryDirectory(prefix="gridworld-") as elsewhere:
            new = Path(elsewhere) / database.name
            MlflowClient(tracking_uri=f"{_SQLITE}{new.as_posix()}").search_experiments()
            write_bytes(database, new.read_bytes(), durable=True)
    client = MlflowClient(tracking_uri=uri)
    place = None if server else (out.absolute() / "artifacts").as_uri()
    found = client.get_experiment_by_name(project)
    experiment = found.experiment_id if found else client.create_experiment(project, artifact_location=place)
    tags = {"gridworld_run": run.identity, "group": run.group}
    there = client.search_runs([experiment], f"tags.gridworld_run = '{run.identity}'")
    if any(each.info.status == "FINISHED" for each in there):
        return uri
    key = (there or [client.create_run(experiment, run_name=run.name, tags=tags)])[0].info.run_id
    curve = [*run.curve, (run.evidence.steps, {**run.curve[-1][1], **run.summary})]
    numbers = [Metric(name, float(each), 0, step) for step, row in curve for name, each in row.items()]
    settings = [
        Param(name, (value if isinstance(value, str) else json.dumps(value))[:_LONGEST_PARAM])
        for name, value in run.settings.items()
    ]
    status = "FAILED"
    try:
        for kind, all_of_it in (("metrics", numbers), ("params", settings)):
            for begin in range(0, len(all_of_it), _MLFLOWS_MOST[kind]):
                client.log_batch(key, **{kind: all_of_it[begin : begin + _MLFLOWS_MOST[kind]]})
        for path in (*run.models, *run.pictures):
            client.log_artifact(key, str(path), "model" if path in run.models else "pictures")
        status = "FINISHED"
    finally:
        client.set_terminated(key, status)
    return uri


def to_hub(run: ExportedRun, out: Path, project: str) -> str:
    """Write the folder of a run in `out`, named for it, and return it; nothing is uploaded."""
    places = (out / run.name, out / f"{run.name}-{run.identity}")
    for folder in places:
        with contextlib.suppress(InputError):  # it is something else
            if read_object(folder / _RESULTS).get("run") == run.identity:
                return str(folder)
    folder = places[places[0].exists()]
    card = _card(run)
    with replacing_folder(folder) as new:
        shutil.copyfile(run.models[0], new / f"{run.group}.zip")
        for path in run.pictures:
            shutil.copyfile(path, new / _shown_as(path))
        write_text(new / "README.md", card)
        if run.is_map:
            write_text(new / "map.txt", run.evidence.layout + "\n")
        else:
            write_bytes(new / WORLD, world_bytes(run.mdp))
        write_json(new / "config.json", dataclasses.asdict(run.config))
        exact = {"is_deterministic": True, "is_exact": True, "run": run.identity}
        write_json(new / _RESULTS, {**run.summary, **_sb3_scores(run), **exact})
    return str(folder)


def to_storm(run: ExportedRun, out: Path, project: str) -> str:
    """Write the world of a run, named for it and its tables, as Storm reads it; returns the file."""
    file = out / f"{run.env}-{run.mdp.digest()[:8]}.drn"
    if not file.exists():
        write_text(file, "".join(drn_lines(run.mdp)))
    return str(file)


def _shown_as(path: Path) -> str:
    return path.name.replace("episode.", "replay.")  # the Hub plays replay.mp4 beside the card


def _sb3_scores(run: ExportedRun) -> dict[str, float]:
    ours = {metric.sb3_name or metric.name: metric.name for metric in METRICS}
    return {name: run.summary[ours[name]] for name in _SHOWN if ours[name] in run.summary}


def _card(run: ExportedRun) -> str:
    is_sb3 = run.config.agent.family == "sb3"
    algorithm = re.sub(r".*/|\.py(?=:)", "", run.config.agent.algorithm).replace(":", ".")  # to import it by
    if not all(part.isidentifier() for part in algorithm.split(".")):
        raise InputError(
            f"config.agent.algorithm={algorithm[:80]!r}: must be the name or import path of a class"
        )
    module, _, name = algorithm.rpartition(".")
    file = f'(folder / "{run.group}.zip")'
    scores = [
        metric.row(
            run.summary.get(metric.name),
            run.summary.get(f"sampled.{metric.name}"),
            run.summary.get(f"optimal_{metric.name}", metric.known_optimum),
        )
        for metric in METRICS
        if metric.in_tables
    ]
    text = _CARD.format(
        group=run.group,
        verdict="Certified optimal" if run.evidence.certified else "Not optimal",
        steps=run.evidence.steps,
        seed=run.evidence.seed,
        scores=to_markdown(Table("scores", "", ("", "greedy", "sampled", "optimum"), scores)),
        images="".join(
            f"![{each.stem}]({_shown_as(each)})\n" for each in run.pictures if each.suffix != ".mp4"
        ),
        the_import=f"from {module or 'stable_baselines3'} import {name}" if is_sb3 else "import numpy as np",
        world=_world(run.config.env),
        load=f"model = {name}.load{file}" if is_sb3 else f"table = np.load{file}",
        policy="model" if is_sb3 else 'q=table["q"]',
        gamma=run.evidence.gamma,
    )
    return f"---\n{yaml.safe_dump(_metadata(run, is_sb3), sort_keys=False, width=10_000)}---\n\n{text}"


def _world(env: EnvConfig) -> str:
    """The lines of Python that make the world."""
    if not isinstance(env, MapConfig):
        return f'env = gridworld.load_world(folder / "{WORLD}")'
    settings = ", ".join(f"{key}={getattr(env, key)!r}" for key in _WORLD)
    made = 'gym.make("gridworld:GridWorld-v0", layout=str(folder / "map.txt"), **world)'
    return f"world = dict({settings})\nenv = {made}"


def _metadata(run: ExportedRun, is_sb3: bool) -> dict[str, Any]:
    world = ENV_ID if run.is_map else run.config.env.name
    library = {"library_name": "stable-baselines3"} if is_sb3 else {}
    scores = [
        {"type": name, "name": f"{name} (exact)", "value": score, "verified": False}
        for name, score in _sb3_scores(run).items()
    ]
    result = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
        "dataset": {"type": world, "name": f"{world}, {run.env}" if run.env != world else world},
        "metrics": scores,
    }
    tags = [world, "deep-reinforcement-learning" if is_sb3 else "tabular", "reinforcement-learning"]
    index = {"name": run.config.agent.algorithm, "results": [result]}
    return {**library, "tags": [*tags, *library.values()], "model-index": [index]}


@dataclass(frozen=True)
class Target:
    """A program or a site that shows runs."""

    write: Callable[[ExportedRun, Path, str], str]  # to a folder, as part of a project; returns where it is
    then: str  # the command that shows or uploads what is at `{place}`, or all that is in `{out}`
    packages: tuple[str, ...] = ()  # that it imports; the target's name is the extra that installs them


TARGETS = {
    "wandb": Target(to_wandb, "wandb sync {out}/wandb/offline-run-*", ("wandb",)),
    "mlflow": Target(to_mlflow, _MLFLOW_UI, ("mlflow", "sqlalchemy", "alembic")),
    "hub": Target(to_hub, "hf upload USER/MODEL {place}"),
    "storm": Target(to_storm, "storm --explicit-drn {place} --prop 'R{{\"reward\"}}max=? [Cdiscount=0.99]'"),
}


def check_installed(name: str) -> None:
    """Raise `InputError` where what a target needs is not installed."""
    for package in TARGETS[name].packages:
        if find_spec(package) is None:
            raise InputError(f"--to {name}: {package} is not installed; {install_command(name)}")
