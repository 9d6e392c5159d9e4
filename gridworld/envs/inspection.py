"""The one door to a certificate: which task an environment or a batch is, and what an agent sees in it.

What is scored has to be what was given: wrappers included, in every copy of a batch. What is not known
exactly is refused. `gridworld.world.sources.wrappers` says what the wrappers of an environment do; here are
the environments below them and the batches above them. Libraries are recognised by the names of their
classes, so that none of them need be imported for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from gridworld.bounds import MOST_STEPS, STEP_LIMIT, at_most
from gridworld.envs.frames.rendering import frame_size
from gridworld.envs.observations import KINDS, ObservationTable, TableObservation, make_observation
from gridworld.errors import InputError
from gridworld.world.grid import GridMdp, compile_mdp
from gridworld.world.layout import Layout, load, positive_int
from gridworld.world.mdp import Mdp
from gridworld.world.sources.gymnasium_table import compile_table, has_table
from gridworld.world.sources.wrappers import NEUTRAL, Wrapped, known_class, same, step_limit

# What a batch is, by the class whose methods it runs.
_GYMNASIUM, _SB3 = "gymnasium.wrappers.vector", "stable_baselines3.common.vec_env"
_NATIVE, _COPIES, _PROCESSES, _TABLE = "native", "copies", "other processes", "table"
_GYMNASIUM_BATCHES = {
    "gridworld.envs.vector_env:GridWorldVectorEnv": _NATIVE,
    "gridworld.envs.statistics_env:StatisticsVectorEnv": _NATIVE,
    "gridworld.envs.observations:VectorTableObservation": _TABLE,
    "gymnasium.vector.sync_vector_env:SyncVectorEnv": _COPIES,
    "gymnasium.vector.async_vector_env:AsyncVectorEnv": _PROCESSES,
    f"{_GYMNASIUM}.common:RecordEpisodeStatistics": NEUTRAL,
    f"{_GYMNASIUM}.dict_info_to_list:DictInfoToList": NEUTRAL,
    f"{_GYMNASIUM}.rendering:HumanRendering": NEUTRAL,
    f"{_GYMNASIUM}.rendering:RecordVideo": NEUTRAL,
}
_SB3_BATCHES = {
    "gridworld.agents.sb3.vec_env:GridWorldVecEnv": _NATIVE,
    f"{_SB3}.dummy_vec_env:DummyVecEnv": _COPIES,
    f"{_SB3}.subproc_vec_env:SubprocVecEnv": _PROCESSES,
    f"{_SB3}.vec_check_nan:VecCheckNan": NEUTRAL,
    f"{_SB3}.vec_monitor:VecMonitor": NEUTRAL,
    f"{_SB3}.vec_video_recorder:VecVideoRecorder": NEUTRAL,
    f"{_SB3}.vec_extract_dict_obs:VecExtractDictObs": "extract",
    f"{_SB3}.vec_normalize:VecNormalize": "normalize",
    f"{_SB3}.vec_transpose:VecTransposeImage": "transpose",
    f"{_SB3}.vec_frame_stack:VecFrameStack": "memory",
}
_BY_METHOD: dict[str, Callable[[Any, Any], Any]] = {  # what SB3's wrappers make of observations (S, ...)
    "extract": lambda wrapper, rows: rows[wrapper.key],
    "normalize": lambda wrapper, rows: wrapper.normalize_obs(rows),
    "transpose": lambda wrapper, rows: wrapper.transpose_observations(rows),
}

Rows = NDArray[Any] | dict[str, NDArray[Any]]  # (S, *shape), or of each entry of a Dict


@dataclass(frozen=True, eq=False)
class Task:
    """What somebody trains on, or asks a score for.

    Attributes:
        mdp: the world, with what wrappers make of rewards and actions.
        max_episode_steps: the step limit of an episode.
        own_limit: the same where the environment has one.
        seen: the observations as they are now, or None where a world alone was given.
        masks: which actions are allowed in each state, (S, A), or None where nothing is said of it.
    """

    mdp: Mdp
    own_limit: int | None = None
    max_episode_steps: int = STEP_LIMIT
    seen: Callable[[], ObservationTable] | None = None
    masks: Callable[[], NDArray[np.bool_] | None] = lambda: None


def task_of(env: Any, max_episode_steps: int | None = None) -> Task:
    """Find out which task an environment is.

    Args:
        env: an environment or a batch of Gymnasium or SB3, wrapped or not: a GridWorld, or one with a
            transition table; a compiled world; or what `load` takes: the name of a map, its file, or a
            `Layout`.
        max_episode_steps: the step limit; None: the environment's own, or 100 where it has none.

    Raises:
        InputError: there is no world in it, or a wrapper may change the task in an unknown way.
    """
    if isinstance(env, Mdp):
        task = Task(env, env.max_episode_steps)
    elif isinstance(env, str | PathLike | Layout):
        task = Task(compile_mdp(load(env)))
    else:
        task = _task(env)
    limit = task.own_limit if max_episode_steps is None else max_episode_steps
    limit = STEP_LIMIT if limit is None else positive_int("max_episode_steps", limit)
    at_most("max_episode_steps", limit, MOST_STEPS)
    return replace(task, max_episode_steps=limit)


def world_of(env: Any) -> Mdp:
    """The world of an environment or a batch, with its step limit.

    Raises:
        InputError: as `task_of`.
    """
    task = _task(env)
    has_limit = isinstance(task.mdp, GridMdp) or task.mdp.max_episode_steps == task.own_limit
    return task.mdp if has_limit else replace(task.mdp, max_episode_steps=task.own_limit)


def _task(env: Any) -> Task:
    if isinstance(env, gym.Env):
        return _single(env)
    if isinstance(env, gym.vector.VectorEnv):
        return _gymnasium_batch(env)
    if hasattr(env, "step_wait"):
        return _sb3_batch(env)
    raise _no_world(env)


def _no_world(env: Any) -> InputError:
    return InputError(
        f"env: {type(env).__name__} has no GridWorld in it and no transition table; must be a GridWorld "
        "environment, one of Gymnasium with a table P, a compiled world, or the name of a map"
    )


def _single(env: gym.Env[Any, Any], like: Task | None = None) -> Task:
    """The task of a single environment; `like`: of another copy in the same batch, to be compared with."""
    real, limit = env.unwrapped, step_limit(env)
    mdp = getattr(real, "mdp", None)
    if isinstance(mdp, GridMdp):
        if known_class(real, {"gridworld.envs.env:GridWorldEnv": _NATIVE}, ("step", "reset")) is None:
            raise InputError(
                f"env: {type(real).__name__} has its own step() or reset(), so it may be another task than "
                "its map says; leave them as they are in GridWorldEnv, or wrap it"
            )
    elif has_table(real):
        is_gymnasiums = type(real).__module__.startswith("gymnasium.envs.")
        mdp = compile_table(real, limit, walked=like is None or not is_gymnasiums)
    else:
        raise _no_world(real)
    wrapped = Wrapped("env", env, mdp)

    def masks() -> NDArray[np.bool_] | None:
        found = wrapped.action_masks()
        return None if found is None else np.stack(found)

    return Task(
        mdp=wrapped.mdp,
        own_limit=limit,
        seen=lambda: _seen(env, wrapped, mdp),
        masks=masks,
    )


def _seen(env: gym.Env[Any, Any], wrapped: Wrapped, mdp: Mdp) -> ObservationTable:
    if not wrapped.transforms and not wrapped.memory:
        return make_observation(mdp, "none")
    only = wrapped.transforms[0] if len(wrapped.transforms) == 1 and not wrapped.memory else None
    if isinstance(only, TableObservation) and type(only).observation is TableObservation.observation:
        return only.table
    return tabulated(env.observation_space, _stacked(wrapped.observations), mdp.num_states)


def _stacked(observations: list[Any]) -> Rows:
    first = observations[0]
    if isinstance(first, dict):
        return {key: np.stack([np.asarray(each[key]) for each in observations]) for key in first}
    if not isinstance(first, np.ndarray | int | np.integer | float | np.floating):
        raise InputError(
            f"env: its observations are of type {type(first).__name__}; must be arrays or numbers"
        )
    return np.asarray(observations)


def _copies(batch: Any) -> Task:
    """The task of a batch's environments, which must be the same in all of them."""
    first, *others = batch.envs
    task = _single(first)
    tasks = [_single(each, task) for each in others]
    for index, other in enumerate(tasks, start=1):
        if other.mdp.text() != task.mdp.text() or other.own_limit != task.own_limit:
            raise InputError(
                f"env: environment {index} of the {type(batch).__name__} is another task than environment 0; "
                "give one of them, or a batch of one task"
            )

    def seen() -> ObservationTable:
        assert task.seen is not None
        table = task.seen()
        for index, other in enumerate(tasks, start=1):
            if other.seen is None or not _same_table(table, other.seen()):
                raise InputError(
                    f"env: environment {index} of the {type(batch).__name__} shows states otherwise than "
                    "environment 0; give one of them, or a batch that shows all alike"
                )
        return table

    return replace(task, seen=seen)


def _same_table(one: ObservationTable, other: ObservationTable) -> bool:
    return one is other or (one.space == other.space and same(_rows(one), _rows(other)))


def _rows(table: ObservationTable) -> Any:
    return table.stored if isinstance(table.stored, dict) else table.table()


def _batch_kind(env: Any, table: dict[str, str], *methods: str) -> str:
    """What is known of a batch or of a wrapper around one, by the methods that decide what it does."""
    kind, name = known_class(env, table, methods), type(env).__name__
    also = {_NATIVE: "advance", _TABLE: "observations"}.get(kind or "")
    if kind is None or (also is not None and known_class(env, table, [also]) is None):
        raise InputError(
            f"env: {name} is no batch, and no wrapper of one, whose effect on the task is known, so nothing "
            "exact is known of what is in it; leave it out, or give one environment as env=..."
        )
    if kind == _PROCESSES:
        raise InputError(
            f"env: {name} has its environments in other processes, where their wrappers cannot be looked at; "
            "give one environment, made as they are, as env=..."
        )
    return kind


def _gymnasium_batch(env: Any) -> Task:
    kind = _batch_kind(env, _GYMNASIUM_BATCHES, "step", "reset")
    if kind == _COPIES:
        return _copies(env)
    if kind == _NATIVE:
        observation = make_observation(env.mdp, "none")
        return Task(env.mdp, env.max_episode_steps, seen=lambda: observation)
    below = _gymnasium_batch(env.env)
    return replace(below, seen=lambda: env.table) if kind == _TABLE else below


def _sb3_batch(env: Any) -> Task:
    kind = _batch_kind(env, _SB3_BATCHES, "step", "step_async", "step_wait", "reset")
    if kind == _COPIES:
        return _copies(env)
    if kind == _NATIVE:
        below = _gymnasium_batch(env.envs)
        return replace(below, seen=lambda: env.observation)
    below = _sb3_batch(env.venv)
    if kind == NEUTRAL:
        return below

    def seen() -> ObservationTable:
        if kind not in _BY_METHOD:
            raise InputError(
                f"env: {type(env).__name__} makes observations of more than the state, so no table "
                "of the policy can be evaluated exactly; leave it out"
            )
        assert below.seen is not None
        return tabulated(
            env.observation_space, _BY_METHOD[kind](env, _rows(below.seen())), below.mdp.num_states
        )

    return replace(below, seen=seen)


def tabulated(space: gym.Space[Any], rows: Any, num_states: int) -> ObservationTable:
    """The table of observations `rows`, (S, *shape) or such arrays by the keys of a Dict."""
    return ObservationTable("of its own", space, num_states, rows)


def observation_like(mdp: Mdp, space: gym.Space[Any]) -> ObservationTable:
    """The observation of a world that has this space.

    Raises:
        InputError: there is none.
    """
    for kind in KINDS:
        table = make_observation(mdp, kind, _cell_size(mdp, space)) if _may_be(mdp, kind, space) else None
        if table is not None and table.space == space:
            return table
    raise InputError(
        f"the model sees {space}, and no observation of this world ({mdp.num_states} states) is like that; "
        f"give the environment that it was trained on, or train on one of {', '.join(KINDS)}"
    )


def _may_be(mdp: Mdp, kind: str, space: gym.Space[Any]) -> bool:
    if kind == "image":
        return isinstance(mdp, GridMdp) and space.dtype == np.uint8 and len(space.shape or ()) == 3
    needs = {"coordinates": mdp.places, "own": mdp.own_observation}
    return kind not in needs or needs[kind] is not None


def _cell_size(mdp: Mdp, space: gym.Space[Any]) -> int:
    """Of the images that have this space, as their width has it; 1 where there is none."""
    if not isinstance(mdp, GridMdp):
        return 1
    width = (space.shape or (1,))[-1]
    per_cell, border = frame_size(mdp, 2)[0] - frame_size(mdp, 1)[0], frame_size(mdp, 1)[0]
    return max(1, (width - border) // per_cell + 1)
