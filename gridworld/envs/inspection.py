"""The one door to a certificate: which task an environment or a batch is, and what an agent sees in it.

What is scored has to be what was given: wrappers included, in every copy of a batch. What is not known
exactly is refused. `gridworld.world.wrappers` says what the wrappers of an environment do; here are
the environments below them and the batches above them, known by the names of their classes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from os import PathLike
from types import MethodType
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from gridworld.base.bounds import MOST_STEPS, STEP_LIMIT, Bounds, positive_int
from gridworld.base.errors import InputError
from gridworld.envs.observations import KINDS, ObservationTable, TableObservation, make_observation
from gridworld.envs.rendering import frame_size
from gridworld.world.grid import GridMdp, compile_mdp
from gridworld.world.layout import Layout, load
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import verified
from gridworld.world.reach import same
from gridworld.world.sources.gymnasium_table import compile_table, has_table
from gridworld.world.wrappers import NEUTRAL, STEPPED_BY, Wrapped, known_class, step_limit, wrappers_of

# What a batch is, by the class whose methods it runs.
_GYMNASIUM, _SB3 = "gymnasium.wrappers.vector", "stable_baselines3.common.vec_env"
_NATIVE, _COPIES, _PROCESSES, _TABLE, _OURS = "native", "copies", "other processes", "table", "native of SB3"
_BATCHES = {
    "gridworld.envs.vector_env:GridWorldVectorEnv": _NATIVE,
    "gridworld.envs.statistics_env:StatisticsVectorEnv": _NATIVE,
    "gridworld.envs.observations:VectorTableObservation": _TABLE,
    "gymnasium.vector.sync_vector_env:SyncVectorEnv": _COPIES,
    "gymnasium.vector.async_vector_env:AsyncVectorEnv": _PROCESSES,
    f"{_GYMNASIUM}.common:RecordEpisodeStatistics": NEUTRAL,
    f"{_GYMNASIUM}.dict_info_to_list:DictInfoToList": NEUTRAL,
    f"{_GYMNASIUM}.rendering:HumanRendering": NEUTRAL,
    f"{_GYMNASIUM}.rendering:RecordVideo": NEUTRAL,
    "gridworld.agents.sb3.vec_env:GridWorldVecEnv": _OURS,
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
# Methods of a batch: who overrides one may do anything.
_DECISIVE = ("step", "reset", "advance", "step_async", "step_wait", "_save_obs", "_obs_from_buf")
_BY_METHOD: dict[str, Callable[[Any, Any], Any]] = {  # what SB3's wrappers make of observations (S, ...)
    "extract": lambda wrapper, rows: rows[wrapper.key],
    "normalize": lambda wrapper, rows: wrapper.normalize_obs(rows),
    "transpose": lambda wrapper, rows: wrapper.transpose_observations(rows),
}


@dataclass(frozen=True, eq=False)
class Task:
    """What somebody trains on, or asks a score for."""

    mdp: Mdp  # the world, with what wrappers make of rewards and actions
    own_limit: int | None = None  # the environment's own step limit, if any
    max_episode_steps: int = STEP_LIMIT
    is_transformed: bool = False  # by wrappers, so that a Discrete observation may be another number
    seen: Callable[[], ObservationTable] | None = None  # as it is now; None: a world alone was given
    # allowed actions (S, A), if anything is said
    masks: Callable[[], NDArray[np.bool_] | None] = lambda: None


def task_of(env: Any, max_episode_steps: int | None = None) -> Task:
    """Find out which task an environment is; refuses what has no world in it or may change it unseen.

    `env` is an environment or a batch of Gymnasium or SB3, wrapped or not, of a GridWorld or with a
    transition table; a compiled world; or a map. Without a limit it is the environment's own, or else 100.
    """
    if isinstance(env, Mdp):
        task = Task(env, env.max_episode_steps)
    elif isinstance(env, PathLike | Layout):
        task = Task(compile_mdp(load(env)))
    else:
        task = _task(env)
    limit = task.own_limit if max_episode_steps is None else max_episode_steps
    limit = STEP_LIMIT if limit is None else positive_int("max_episode_steps", limit)
    Bounds(high=MOST_STEPS).check("max_episode_steps", limit)
    return replace(task, max_episode_steps=limit)


def world_of(env: Any) -> Mdp:
    """The world of an environment or a batch, with its step limit."""
    task = _task(env)
    mdp, limit = task.mdp, task.own_limit
    return mdp if limit in (None, mdp.default_step_limit) else replace(mdp, max_episode_steps=limit)


def _task(env: Any) -> Task:
    if isinstance(env, gym.Env):
        return _single(env)
    if isinstance(env, gym.vector.VectorEnv) or hasattr(env, "step_wait"):
        return _batch(env)
    raise _no_world(env)


def _no_world(env: Any) -> InputError:
    return InputError(
        f"env: {type(env).__name__} contains neither a GridWorld nor a transition table; must be a "
        "GridWorld environment, a Gymnasium one with a table P, a compiled world, or a world's name; another "
        "environment of Gymnasium is enumerated if its id is given, e.g. compile_env('my_module:My-v0')"
    )


def _single(env: gym.Env[Any, Any]) -> Task:
    real, limit = env.unwrapped, step_limit(env)
    innermost = [env, *(wrapper.env for wrapper in wrappers_of(env))][-1]
    mdp = getattr(real, "mdp", None)
    if real is not innermost or not isinstance(real, gym.Env):
        raise InputError(
            f"env: {type(innermost).__name__} replaces {type(real).__name__} and may change its steps, so "
            "it cannot be solved exactly; make it a gymnasium.Wrapper"
        )
    if isinstance(mdp, GridMdp):
        methods = (*STEPPED_BY, "mdp", "np_random")
        if known_class(real, {"gridworld.envs.env:GridWorldEnv": _NATIVE}, methods) is None:
            raise InputError(
                f"env: {type(real).__name__} has its own step() or reset(), so its task may differ from its "
                "map; leave them as in GridWorldEnv, or wrap it"
            )
        verified(mdp, "env")
    elif has_table(real):
        mdp = compile_table(real, limit)
    else:
        raise _no_world(real)
    wrapped = Wrapped("env", env, mdp)
    is_number = isinstance(env.observation_space, gym.spaces.Discrete)  # maybe of an earlier state
    return Task(
        mdp=wrapped.mdp,
        own_limit=limit,
        is_transformed=bool(wrapped.transforms or (wrapped.memory and is_number)),
        seen=functools.cache(lambda: _seen(env, wrapped, mdp)),
        masks=lambda: wrapped.action_masks,
    )


def _seen(env: gym.Env[Any, Any], wrapped: Wrapped, mdp: Mdp) -> ObservationTable:
    if not wrapped.transforms and not wrapped.memory:
        return make_observation(mdp, "none")
    only = wrapped.transforms[0] if len(wrapped.transforms) == 1 and not wrapped.memory else None
    own = getattr(only, "observation", None)
    if isinstance(only, TableObservation) and own == MethodType(TableObservation.observation, only):
        return only.table
    space = env.observation_space
    return tabulated(space, _stacked(wrapped.observations, space), mdp.num_states)


def _stacked(observations: list[Any], space: gym.Space[Any]) -> Any:
    """All observations in one array, of the space's type as batches have them."""
    if isinstance(space, gym.spaces.Dict):
        return {key: _stacked([each[key] for each in observations], inner) for key, inner in space.items()}
    try:
        given = np.stack([np.asarray(each) for each in observations])
        rows = given.astype(space.dtype)
    except (TypeError, ValueError):
        raise InputError(f"env: its observations are not arrays of its space, {space}") from None
    if not np.allclose(rows.astype(np.float64), given.astype(np.float64), rtol=1e-3, atol=1e-6):
        raise InputError(
            f"env: its observations are {given.dtype}, but its space says {space.dtype}, and a batch "
            "converts them; correct the dtype of the space"
        )
    return rows


def _copies(batch: Any) -> Task:
    """The task of a batch's environments, which must be the same in all of them."""
    first, *others = batch.envs
    if len({id(each.unwrapped) for each in batch.envs}) < len(batch.envs):
        raise InputError(
            f"env: the {type(batch).__name__} contains the same environment twice; make a new one for each"
        )
    task = _single(first)
    tasks = {index: _single(other) for index, other in enumerate(others, 1)}

    def refuse_others(is_same: Callable[[Task], bool], mistake: str) -> None:
        for index, other in tasks.items():
            if not is_same(other):
                raise InputError(
                    f"env: environment {index} of the {type(batch).__name__} {mistake} environment 0; give "
                    "one of them, or a batch with a single task"
                )

    def seen() -> ObservationTable:
        table = task.seen()  # type: ignore[misc]

        def shows_the_same(other: Task) -> bool:
            theirs = other.seen()  # type: ignore[misc]
            return table.space == theirs.space and same(_rows(table), _rows(theirs))

        refuse_others(shows_the_same, "shows states differently from")
        return table

    def masks() -> NDArray[np.bool_] | None:
        mine: Any = task.masks()
        refuse_others(lambda other: np.array_equal(mine, other.masks()), "masks actions differently from")  # type: ignore[arg-type]
        return mine  # type: ignore[no-any-return]

    text, limit = Mdp.text(task.mdp), task.own_limit
    refuse_others(
        lambda other: (Mdp.text(other.mdp), other.own_limit) == (text, limit), "is a different task from"
    )
    return replace(task, seen=functools.cache(seen), masks=masks)


def _rows(table: ObservationTable) -> Any:
    return table.stored if isinstance(table.stored, dict) else table.table()


def _batch(env: Any) -> Task:
    of_wrapper = ("observations",) if isinstance(env, gym.vector.VectorWrapper) else ()
    kind, name = known_class(env, _BATCHES, (*_DECISIVE, *of_wrapper)), type(env).__name__
    if kind is None:
        raise InputError(
            f"env: {name} is not a known batch or batch wrapper, so what it does to the task is unknown; "
            "leave it out, or give a single environment as env=..."
        )
    if kind == _PROCESSES:
        raise InputError(
            f"env: {name} runs its environments in other processes, where their wrappers cannot be "
            "inspected; give one such environment as env=..."
        )
    if kind == _COPIES:
        return _copies(env)
    if kind == _NATIVE:
        verified(env.mdp, "env")
        limit = env.step_limit if env.step_limit <= MOST_STEPS else None  # what it plays by
        return Task(env.mdp, limit, seen=lambda: make_observation(env.mdp, "none"))
    if kind == _OURS:
        return replace(_batch(env.envs), seen=lambda: env.observation)
    below = _batch(env.env if isinstance(env, gym.vector.VectorWrapper) else env.venv)
    if kind == NEUTRAL:
        return below
    if kind == _TABLE:
        return replace(below, seen=lambda: env.table)

    def seen() -> ObservationTable:
        if kind not in _BY_METHOD:
            raise InputError(
                f"env: {name} makes observations that depend on more than the state, so no policy can be "
                "evaluated exactly; leave it out"
            )
        assert below.seen is not None
        rows = _BY_METHOD[kind](env, _rows(below.seen()))
        return tabulated(env.observation_space, rows, below.mdp.num_states)

    return replace(below, seen=seen)


def tabulated(space: gym.Space[Any], rows: Any, num_states: int) -> ObservationTable:
    """The table of observations `rows`, (S, *shape) or such arrays by the keys of a Dict."""
    return ObservationTable("of its own", space, num_states, rows)


def observation_like(mdp: Mdp, space: gym.Space[Any]) -> ObservationTable:
    """The observation of a world that has this space."""
    width = (space.shape or (0,))[-1] if space.dtype == np.uint8 and len(space.shape or ()) == 3 else None
    for kind in KINDS:
        if kind == "image" and width is None:
            continue
        try:
            cell_size = 1 if width is None else max(1, width // frame_size(mdp, 1)[0])
            table = make_observation(mdp, kind, cell_size)
        except InputError:  # the world has nothing of this kind
            continue
        if table.space == space:
            return table
    raise InputError(
        f"the model expects {space}, which no observation of this world ({mdp.num_states} states) has; give "
        f"the environment that it was trained on, or train on one of {', '.join(KINDS)}"
    )
