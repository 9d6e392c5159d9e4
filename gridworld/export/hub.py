"""A folder for the Hugging Face Hub: a model card with the exact scores, the model, the replay, the settings.

The card's metadata are laid out as huggingface_sb3 and RL Zoo write them
(https://huggingface.co/docs/hub/model-cards). Names out of a run stand in it with the signs of a file's name
or of an import path.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from pathlib import Path
from typing import Any

import yaml

from gridworld.config.worlds import EnvConfig, MapConfig
from gridworld.envs.registration import ENV_ID
from gridworld.errors import InputError
from gridworld.export.exported_run import ExportedRun
from gridworld.report.tables import Table, to_markdown
from gridworld.run.folder import WORLD
from gridworld.storage.atomic_write import replacing_folder, write_json, write_text
from gridworld.storage.safe_read import read_object
from gridworld.world.metrics import METRICS

_RESULTS = "results.json"
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
pip install gridworld-sb3 huggingface_hub
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


def to_hub(run: ExportedRun, out: Path, project: str) -> str:
    """Write the folder of a run in `out`, named for it, and return it; nothing is uploaded."""
    folder = out / run.name
    with contextlib.suppress(InputError):  # it is something else
        if read_object(folder / _RESULTS).get("run") == run.identity:
            return str(folder)
    if folder.exists():
        folder = out / f"{run.name}-{run.identity}"
        if folder.exists():
            return str(folder)
    card = _card(run)
    with replacing_folder(folder) as new:
        shutil.copyfile(run.models[0], new / f"{run.group}.zip")
        for path in run.pictures:
            shutil.copyfile(path, new / _shown_as(path))
        write_text(new / "README.md", card)
        if run.world is None:
            write_text(new / "map.txt", run.evidence.layout + "\n")
        else:
            shutil.copyfile(run.world, new / WORLD)
        write_json(new / "config.json", dataclasses.asdict(run.config))
        exact = {"is_deterministic": True, "is_exact": True, "run": run.identity}
        write_json(new / _RESULTS, {**run.summary, **_sb3_scores(run), **exact})
    return str(folder)


def _shown_as(path: Path) -> str:
    return path.name.replace("episode.", "replay.")  # the Hub plays replay.mp4 beside the card


def _sb3_scores(run: ExportedRun) -> dict[str, float]:
    ours = {metric.sb3_name or metric.name: metric.name for metric in METRICS}
    return {name: run.summary[ours[name]] for name in _SHOWN if ours[name] in run.summary}


def _card(run: ExportedRun) -> str:
    algorithm, is_sb3 = run.config.agent.algorithm, run.config.agent.family == "sb3"
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
        steps=run.steps,
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
    world = ENV_ID if isinstance(run.config.env, MapConfig) else run.config.env.name
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
