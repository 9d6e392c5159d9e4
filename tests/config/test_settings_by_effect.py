"""What a setting affects is declared at it; everybody goes by that: hashes, reports, recipes, searches."""

import copy
import dataclasses
import json
from collections import defaultdict
from typing import Any

import pytest

from gridworld.base.errors import InputError
from gridworld.config.fields import Effect
from gridworld.config.settings import agent_schemas, effect_of, flat
from gridworld.config.sweep import DimensionConfig
from gridworld.config.train import TrainConfig
from gridworld.report.evidence import Evidence
from gridworld.report.grouping import learning_key, task_key
from gridworld.run.provenance import identity, settings_hash
from gridworld.sweeps.tune.study import _relevant
from gridworld.sweeps.tune.study_spec import SearchSpace
from gridworld.training.tensorboard import hparams

DECLARED = {
    Effect.LENGTH: {"total_timesteps"},
    Effect.SEED: {"seed"},
    Effect.MACHINE: {"device", "threads"},
    Effect.TASK: {
        *("env.layout", "env.num_rows", "env.num_cols", "env.slip", "env.max_episode_steps"),
        *("env.step_reward", "env.goal_reward", "env.trap_reward", "env.rewards", "evaluation.gamma"),
    },
    Effect.EVALUATION: {"evaluation.every", "evaluation.stop_after"},
    Effect.LABELS: {
        *("agent.name", "agent.log_interval", "agent.stats_window_size"),
        "agent.arguments.stats_window_size",
    },
    Effect.FILES: {
        *("logging.tensorboard", "logging.policy_map_every", "recording.policy_map", "recording.q_error"),
        *("recording.visits", "recording.learning", "recording.frames", "recording.gif", "recording.mp4"),
        *("recording.cell_size", "recording.fps"),
    },
    Effect.NOTHING: {
        "logging.progress",
        "logging.wandb",
        "checkpoint.every",
        "recipe",
        "env.recipes_of",
        "known_failure",
    },
}
# Who goes by a setting of each effect; the task of the report's groups has a key of its own.
EVERYBODY = {"identity", "sweep", "hparams", "group", "recipe", "search"}
GO_BY = {
    Effect.LEARNING: EVERYBODY,
    Effect.LENGTH: EVERYBODY - {"identity", "search"},
    Effect.TASK: EVERYBODY - {"group", "search"} | {"task"},
    Effect.EVALUATION: EVERYBODY - {"search"},
    Effect.SEED: {"identity", "sweep", "hparams"},
    Effect.MACHINE: {"identity", "sweep", "hparams"},
    Effect.LABELS: {"identity", "sweep", "hparams", "recipe"},
    Effect.FILES: {"identity"},
    Effect.NOTHING: set(),
}
OF_THE_MAP = {"env.layout", "env.num_rows", "env.num_cols"}  # the map itself makes the task, not its name
CONFIGS = {
    name: dataclasses.replace(TrainConfig(), agent=dataclasses.replace(schema(), name=name))
    for name, schema in agent_schemas().items()
}
CONFIGS["sb3"].agent.arguments = {"stats_window_size": 100, "gae_lambda": 0.5}  # type: ignore[attr-defined]
FIELDS = {key: agent for agent, config in CONFIGS.items() for key, _ in flat(dataclasses.asdict(config))}


def test_every_field_affects_what_is_declared() -> None:
    """Outside of the agent's section, a new one has to be added above."""
    found = defaultdict(set)
    for key in FIELDS:
        found[effect_of(key)].add(key)
    learning = found.pop(Effect.LEARNING)
    assert found == DECLARED
    assert {key for key in learning if not key.startswith("agent.")} == {
        *("exploration_bonus", "exploring_starts", "stratified_draws", "callbacks", "n_envs"),
        *("observation.kind", "observation.cell_size", "observation.features"),
    }


@pytest.mark.parametrize("effect", Effect)
def test_everybody_goes_by_what_a_field_affects(effect: Effect) -> None:
    before = {agent: answers(config) for agent, config in CONFIGS.items()}
    for key, agent in FIELDS.items():
        if effect_of(key) is effect:
            after = answers(changed(CONFIGS[agent], key))
            seen = {name for name, answer in after.items() if answer != before[agent][name]}
            seen |= {"search"} if is_searched(key) else set()
            assert seen == GO_BY[effect] - ({"task"} if key in OF_THE_MAP else set()), key


def changed(config: TrainConfig, key: str) -> TrainConfig:
    """With another value there, of whatever type."""
    other = copy.deepcopy(config)
    *path, last = key.split(".")
    place: Any = other
    for name in path:
        place = place[name] if isinstance(place, dict) else getattr(place, name)
    if isinstance(place, dict):
        place[last] = "another"
    else:
        setattr(place, last, "another")
    return other


def answers(config: TrainConfig) -> dict[str, Any]:
    """By which everybody tells two settings apart."""
    run = object.__new__(Evidence)  # as much of a run as its keys are of
    settings = {key: json.dumps(value) for key, value in flat(dataclasses.asdict(config))}
    for name, value in {"settings": settings, "layout": "S.G", "env": "classic"}.items():
        object.__setattr__(run, name, value)
    object.__setattr__(run, "gamma", config.evaluation.gamma)
    return {
        "identity": identity(config, "S.G"),
        "sweep": settings_hash(dataclasses.asdict(config), "S.G"),
        "hparams": hparams(config),
        "group": learning_key(run),
        "task": task_key(run),
        "recipe": _relevant(config),
    }


def is_searched(key: str) -> bool:
    try:
        SearchSpace({key: DimensionConfig("categorical", choices=[1, 2])})
    except InputError:
        return False
    return True


def test_hashes_are_those_of_folders_that_are_there_already() -> None:
    """Of settings as a manifest has them; a sweep goes on by these."""
    content = {
        "seed": 3,
        "agent": {"name": "a", "log_interval": 1, "arguments": {}, "policy_kwargs": {"net_arch": None}},
        "env": {"slip": 0.1},
        "evaluation": {"every": 100, "gamma": 0.9},
        "logging": {"tensorboard": True, "progress": True},
        "recording": {"fps": 4},
        "checkpoint": {"every": "auto"},
    }
    digest = "3c58f454d7144c4541f5c486b06142f3"
    assert settings_hash(content, "S.G") == digest
    of_another_version: dict[str, Any] = {"logging": {"surprise": 1}, "recording": {}, "checkpoint": 5}
    assert settings_hash(content | of_another_version, "S.G") == digest
    assert settings_hash(content | {"surprise": 1}, "S.G") != digest
