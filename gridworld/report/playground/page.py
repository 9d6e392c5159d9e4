"""The page as one file: its template, style, scripts and data, for a browser without a server or a network.

The scripts are JavaScript modules; in the page they are one, without the lines that import and export. What
is in the data is only ever shown as text.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from gridworld.base.console import plain, tell
from gridworld.base.errors import InputError
from gridworld.base.serialization import StateError, fitting
from gridworld.config.compose import compose
from gridworld.config.recipe_file import literal
from gridworld.config.words import conf_folder, refuse_unclear
from gridworld.config.worlds import MapConfig, each_once
from gridworld.report.evidence import plain_name
from gridworld.run.checkpoints import Checkpoints
from gridworld.training.saved_run import SavedRun, read_visits
from gridworld.visualization.picture import Moment, PolicyHistory
from gridworld.world.chain import one_hot_policy
from gridworld.world.grid import GridMdp
from gridworld.world.mdp import IntArray, Mdp

_MODULES = ("world", "solver", "learners", "view", "show", "app")  # in the order of their imports
_IMPORT = re.compile(r'^import \{[^}]*\} from "\./\w+\.js";\n', re.MULTILINE)
_MOST_STATES, _MOST_SIDE, _MOST_OUTCOMES = 2500, 60, 100_000  # the first two are in world.js too
_DIGITS = 6  # of values in a run's history, which has them as float32
_SETTINGS = ("slip", "step_reward", "goal_reward", "trap_reward")
GAMMA = 0.99
# Shows the page in another one, as high as it is: {} is `src=` or `srcdoc=`.
FRAME = """<iframe class="playground" {} title="The playground" loading="lazy" \
style="width: 100%; height: 1100px; border: 0"></iframe>
<script>addEventListener("message", ({{ data, source }}) => document.querySelectorAll(".playground").forEach(
frame => frame.contentWindow === source && (frame.style.height = `${{data.playground}}px`)))</script>"""


def page_of(words: Sequence[str], conf: Sequence[str] = (), best: bool = False, trust: bool = False) -> str:
    """The page of what a command line names: a world, a map file, settings as for `train`, a run's folder."""
    alone = words[0] if len(words) == 1 else ""
    is_path = Path(alone).exists() or os.sep in alone.partition("=")[0]  # a run of a sweep may be seed=0
    name = alone if is_path or "=" not in alone else ""
    if name.endswith(os.sep) or (name and Path(name).is_dir()):
        return run_page(SavedRun(Path(name), trust, best))
    if folders := [word for word in words if Path(word).is_dir()]:
        raise InputError(f"{folders[0]}: is a folder; give it alone, since a run has its own settings")
    if os.sep in name and not Path(name).exists():
        raise InputError(f"{name}: no such run or map file")
    if best:
        raise InputError("--best: chooses between the models of a run; give the run's folder")
    if name:
        words = [f"env.layout={literal(name, 'layout')}" if name.endswith(".txt") else f"env={name}"]
    refuse_unclear([*words, *conf])
    world = each_once()
    config = compose([*words, *conf], world)
    mdp = world(config.env)
    return world_page(mdp, config.evaluation.gamma, config.env.step_limit(mdp))


def world_page(mdp: Mdp, gamma: float, step_limit: int) -> str:
    """The page of a world; one that is not a map is shown as a table of its states."""
    return _page(_world(mdp, gamma, step_limit))


def maps_page() -> str:
    """The page of the shipped maps, for links to any map."""
    return _page({"shipped": shipped(), "title": "", "gamma": GAMMA, "link": ""})


def run_page(saved: SavedRun) -> str:
    """The page of a run: its world, and the policies it kept while it learned, the last one with its Q."""
    mdp, config, evaluator = saved.mdp, saved.config, saved.evaluator()
    data = _world(mdp, config.evaluation.gamma, evaluator.max_episode_steps)
    last, steps = saved.snapshot(), saved.steps()
    if not np.isfinite(last.values).all() or (last.q is not None and not np.isfinite(last.q).all()):
        raise InputError(f"{saved.run.folder}: the agent's values are not finite numbers")
    damage: list[str] = []
    moments = [moment for moment in _kept(saved, damage) if moment.step < steps]
    greedy: list[IntArray] = [*(moment.greedy for moment in moments), last.greedy]
    values: list[NDArray[Any]] = [*(moment.values for moment in moments), last.values]
    regrets = [evaluator.score(one_hot_policy(each, mdp.num_actions)).regret for each in greedy]
    try:
        visits = read_visits(saved.run, mdp.next_state.shape[:2]).ravel().tolist()
    except InputError as error:  # the rest can be shown without
        visits = None
        damage.append(str(error))
    for each in damage:
        tell(f"{each}; the page is without it")
    data["run"] = {
        "title": f"{plain_name(config.agent.name)} on {data['title']}, seed {config.seed}, {steps:,} steps",
        "agent": config.agent.name,
        "gamma": config.evaluation.gamma,
        "agent_gamma": float(getattr(config.agent, "gamma", config.evaluation.gamma)),
        "steps": [*(moment.step for moment in moments), steps],
        "regrets": [regret if math.isfinite(regret) else None for regret in regrets],
        "greedy": [each.tolist() for each in greedy],
        "values": [[float(f"{value:.{_DIGITS}g}") for value in each.tolist()] for each in values],
        "q": None if last.q is None else last.q.ravel().tolist(),
        "visits": visits,
        "damage": list(map(plain, damage)),
    }
    return _page(data)


def link(mdp: Mdp, gamma: float, step_limit: int) -> str | None:
    """What follows `#` in the page's address, for `readLink` in world.js; None: a link cannot hold it."""
    if not isinstance(mdp, GridMdp) or mdp.layout.ends:
        return None
    settings = {key: getattr(mdp, key) for key in _SETTINGS}
    settings |= {"max_episode_steps": step_limit, "gamma": gamma}
    tiles = mdp.text().replace("#", "W").replace("\n", "_")
    return "&".join([f"map={tiles}", *(f"{key}={value!r}" for key, value in settings.items())])


def fits(mdp: Mdp) -> bool:
    """Whether a world is small enough for the page."""
    sides = (mdp.layout.num_rows, mdp.layout.num_cols) if isinstance(mdp, GridMdp) else (1,)
    outcomes = mdp.num_states <= _MOST_STATES and mdp.probability.size <= _MOST_OUTCOMES
    return outcomes and max(sides) <= _MOST_SIDE


def _world(mdp: Mdp, gamma: float, step_limit: int) -> dict[str, Any]:
    if not fits(mdp):
        raise InputError(
            f"{mdp.name}: is too large for the playground, which shows at most {_MOST_STATES:,} states, in "
            f"maps of at most {_MOST_SIDE} rows and columns, with {_MOST_OUTCOMES:,} outcomes of all actions"
        )
    data: dict[str, Any] = {"shipped": shipped(), "title": plain_name(mdp.name), "gamma": gamma}
    if address := link(mdp, gamma, step_limit):
        return data | {"link": address}
    arrays = {
        "next": mdp.next_state,
        "prob": mdp.probability,
        "reward": mdp.reward,
        "thresholds": np.minimum(mdp.thresholds, 2.0),  # some are infinite, which JSON has no word for
        "start": mdp.start,
    }
    masks = {"terminal": mdp.terminal, "goal": mdp.goal, "absorbing": mdp.absorbing}
    return data | {
        "tables": {
            **{key: np.ravel(array).tolist() for key, array in arrays.items()},
            **{key: mask.astype(int).tolist() for key, mask in masks.items()},
            **dict(zip("nAK", mdp.next_state.shape, strict=True)),
            "actions": [plain_name(name) for name in mdp.action_names],
            "names": [plain_name(mdp.state_name(state)) for state in range(mdp.num_states)],
            "limit": step_limit,
        }
    }


@cache
def shipped() -> dict[str, dict[str, Any]]:
    """The shipped maps by the names of their worlds: their text, and their settings in `conf/env`."""
    found = {}
    for file in sorted((conf_folder() / "env").glob("*.yaml")):
        content = yaml.safe_load(file.read_text("utf-8"))
        if "layout" in content:
            env = MapConfig(**content)
            mdp = env.compile()
            settings = {key: getattr(mdp, key) for key in _SETTINGS}
            settings |= {"max_episode_steps": env.step_limit(mdp), "gamma": GAMMA}
            found[file.stem] = {"text": mdp.text(), "settings": settings}
    return found


def _kept(saved: SavedRun, damage: list[str]) -> list[Moment]:
    """The evaluations that a run's newest checkpoint has for the animation of learning; none without one.

    A sentence for each that is damaged is added to `damage`.
    """
    size, actions = saved.mdp.next_state.shape[:2]
    if not saved.config.recording.learning:
        return []
    for path, state in Checkpoints(saved.run.folder).states():
        try:
            if isinstance(state, StateError):
                raise state
            with fitting():
                history = PolicyHistory(size)
                history.set_state(state["pictures"]["history"])
                moments = history.moments()
                for moment in moments:
                    is_whole = moment.values.shape == moment.greedy.shape == (size,) and moment.step >= 0
                    if not (is_whole and np.isfinite(moment.values).all() and moment.greedy.max() < actions):
                        raise StateError("is not a history of this world")
            return moments
        except StateError as error:
            damage.append(f"{path}: {error}")
    return []


def _page(data: dict[str, Any]) -> str:
    template, style, *modules = (
        files(__package__).joinpath(name).read_text("utf-8")
        for name in ("page.html", "style.css", *(f"{module}.js" for module in _MODULES))
    )
    script = "".join(re.sub(r"^export ", "", _IMPORT.sub("", text), flags=re.MULTILINE) for text in modules)
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    head, body, middle, end = re.split(r"/\* [\w.]+ \*/", template)
    return "".join((head, style, body, text, middle, script, end))
