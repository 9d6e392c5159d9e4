"""Which task an environment or a batch is, and what an agent sees in it: is it ours, or does the door find
it?

What is scored has to be what was given: wrappers included, in every copy of a batch. A world here and a
transition table are known; anything else is found by trying every action (`gridworld.world.door`). Here are
the batches above environments, known by their classes.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from os import PathLike
from types import MethodType
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from gridworld.base.bounds import MOST_STEPS, STEP_LIMIT, Bounds, positive_int
from gridworld.base.errors import InputError, in_short
from gridworld.envs.env import GridWorldEnv
from gridworld.envs.observations import KINDS, ObservationTable, TableObservation, make_observation
from gridworld.envs.rendering import frame_size
from gridworld.world.door import known
from gridworld.world.door.attributes import layers_of
from gridworld.world.door.world import Found, enumerated, traits
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import Layout, load
from gridworld.world.mdp import Mdp, leaves_of
from gridworld.world.outcomes import verified
from gridworld.world.sources.environment import as_environment, found_by, shortcut, step_limit

# What a batch is, by the class whose methods it runs.
_GYMNASIUM, _SB3 = "gymnasium.wrappers.vector", "stable_baselines3.common.vec_env"
_NEUTRAL, _NATIVE, _COPIES, _PROCESSES, _TABLE, _OURS = (
    "neutral",
    "native",
    "copies",
    "other processes",
    "table",
    "native of SB3",
)
_BATCHES = {
    "gridworld.envs.vector_env:GridWorldVectorEnv": _NATIVE,
    "gridworld.envs.training_env:TrainingVectorEnv": _NATIVE,
    "gridworld.envs.observations:VectorTableObservation": _TABLE,
    "gymnasium.vector.sync_vector_env:SyncVectorEnv": _COPIES,
    "gymnasium.vector.async_vector_env:AsyncVectorEnv": _PROCESSES,
    f"{_GYMNASIUM}.common:RecordEpisodeStatistics": _NEUTRAL,
    f"{_GYMNASIUM}.dict_info_to_list:DictInfoToList": _NEUTRAL,
    f"{_GYMNASIUM}.rendering:HumanRendering": _NEUTRAL,
    f"{_GYMNASIUM}.rendering:RecordVideo": _NEUTRAL,
    "gridworld.agents.sb3.vec_env:GridWorldVecEnv": _OURS,
    f"{_SB3}.dummy_vec_env:DummyVecEnv": _COPIES,
    f"{_SB3}.subproc_vec_env:SubprocVecEnv": _PROCESSES,
    f"{_SB3}.vec_check_nan:VecCheckNan": _NEUTRAL,
    f"{_SB3}.vec_monitor:VecMonitor": _NEUTRAL,
    f"{_SB3}.vec_video_recorder:VecVideoRecorder": _NEUTRAL,
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

    mdp: Mdp  # the world, wrappers included
    own_limit: int | None = None  # the environment's own step limit, if any
    max_episode_steps: int = STEP_LIMIT
    is_found: bool = False  # by search, so that a table's rows are by what is shown
    seen: Callable[[], ObservationTable] | None = None  # as it is now; None: a world alone was given
    # allowed actions (S, A), if anything is said
    masks: Callable[[], NDArray[np.bool_] | None] = lambda: None
    normalizer: Any = None  # SB3's VecNormalize around it, if that changes observations


def task_of(env: Any, max_episode_steps: int | None = None, **bounds: Any) -> Task:
    """Find out which task an environment is; refuses what has no world in it or may change it unseen.

    `env` is an environment or a batch of Gymnasium or SB3, wrapped or not; a class or a function that makes
    one; a compiled world; or a map. Without a limit it is the environment's own, or else 100. `bounds`: see
    `enumerated`.
    """
    if isinstance(env, Mdp):
        task = Task(env, env.max_episode_steps)
    elif isinstance(env, PathLike | Layout):
        task = Task(compile_mdp(load(env)))
    else:
        task = _task(env, **bounds)
    limit = task.own_limit if max_episode_steps is None else max_episode_steps
    limit = STEP_LIMIT if limit is None else positive_int("max_episode_steps", limit)
    Bounds(high=MOST_STEPS).check("max_episode_steps", limit)
    return replace(task, max_episode_steps=limit)


def world_of(env: Any, **bounds: Any) -> Mdp:
    """The world of an environment or a batch, with its step limit."""
    task = _task(env, **bounds)
    mdp, limit = task.mdp, task.own_limit
    return mdp if limit in (None, mdp.default_step_limit) else replace(mdp, max_episode_steps=limit)


def _task(env: Any, **bounds: Any) -> Task:
    is_env = isinstance(env, gym.Env)
    if not is_env and (isinstance(env, gym.vector.VectorEnv) or hasattr(env, "step_wait")):
        return _batch(env, **bounds)
    if not is_env and callable(env):
        return _made(env, **bounds)
    wanted = "an environment or a batch of Gymnasium or SB3, a class or a function that makes one, a compiled"
    return _single(as_environment("env", env, f"{wanted} world, or a world's name"), **bounds)


def _made(make: Any, **bounds: Any) -> Task:
    """The task of what a class or a function makes."""

    def made() -> gym.Env[Any, Any]:
        try:
            env = make()
        except Exception as error:  # it may raise anything
            name = getattr(make, "__name__", type(make).__name__)
            raise InputError(f"env: {name}() cannot make an environment ({in_short(error)})") from error
        return as_environment("env", env)

    with closing(made()) as env:
        return _known(env, **bounds) or _task_of_found(found_by(made, **bounds))


def _single(env: gym.Env[Any, Any], **bounds: Any) -> Task:
    return _known(env, **bounds) or _task_of_found(enumerated("env", env, **bounds))


def _known(
    env: gym.Env[Any, Any], ignore: Sequence[str] = (), state: Any = None, **bounds: Any
) -> Task | None:
    """The task of an environment of ours, or of one with a table that its steps follow."""
    if ignore or state is not None:  # what the user says is asked of the search
        return None
    if (task := _ours(env)) is not None:
        return task
    if (mdp := shortcut(env)) is not None:
        return Task(mdp, step_limit(env), seen=lambda: make_observation(mdp, "none"))
    return None


def _task_of_found(found: Found) -> Task:
    return Task(
        found.mdp,
        found.mdp.max_episode_steps,
        is_found=True,
        seen=functools.cache(lambda: ObservationTable(found.space, found.mdp.num_states, found.rows)),
        masks=lambda: found.masks,
    )


def _ours(env: gym.Env[Any, Any]) -> Task | None:
    """The task of a GridWorld that steps as ours does, with no wrapper but of our observations."""
    *outer, real = layers_of(env)
    methods = ("step", "reset", "mdp", "np_random", "unwrapped")
    if known_class(real, {"gridworld.envs.env:GridWorldEnv": _NATIVE}, methods) is None:
        return None
    shown = [each for each in outer if not (known.is_neutral(each) or known.is_limit(each))]
    is_table = len(shown) == 1 and known.steps_once(shown[0]) and isinstance(shown[0], TableObservation)
    if (shown and not (is_table and _is_inherited(shown[0]))) or hasattr(real, "action_masks"):
        return None
    assert isinstance(real, GridWorldEnv)
    verified(real.mdp, "env")
    table = shown[0].table if shown else make_observation(real.mdp, "none")
    return Task(real.mdp, step_limit(env), seen=lambda: table)


def _is_inherited(wrapper: Any) -> bool:
    own = getattr(wrapper, "observation", None)
    return own == MethodType(TableObservation.observation, wrapper) and "reset" not in vars(wrapper)


def known_class(thing: Any, table: dict[str, str], methods: Sequence[str]) -> str | None:
    """What a table by "module:class" says of the first known ancestor of an object, whose `methods` it runs.

    None if there is none, or a method is its own.
    """
    kind, held = type(thing), getattr(thing, "__dict__", {}).keys() - {"env"}
    for base in kind.__mro__:
        if entry := table.get(f"{base.__module__}:{base.__qualname__}"):
            inherited = all(getattr(kind, name, None) is getattr(base, name, None) for name in methods)
            return entry if inherited and not any(name in held for name in methods) else None
    return None


def _copies(batch: Any, **bounds: Any) -> Task:
    """The task of a batch's environments, which must be the same in all of them."""
    first, *others = batch.envs
    if len({id(each.unwrapped) for each in batch.envs}) < len(batch.envs):
        raise InputError(
            f"env: the {type(batch).__name__} contains the same environment twice; make a new one for each"
        )
    task = _single(first, **bounds)
    same = traits(first) if others and task.is_found else None
    tasks = {
        index: task if task.is_found and traits(other) == same else _single(other, **bounds)
        for index, other in enumerate(others, 1)
    }

    def shared(
        of: Callable[[Any], Any], mistake: str, is_same: Callable[[Any, Any], bool] = operator.eq
    ) -> Any:
        """What is the same in all environments; refuses one in which it is not."""
        mine = of(task)
        for index, other in tasks.items():
            if not is_same(mine, of(other)):
                raise InputError(
                    f"env: environment {index} of the {type(batch).__name__} {mistake} environment 0; give "
                    "one of them, or a batch with a single task"
                )
        return mine

    shared(lambda each: (Mdp.text(each.mdp), each.own_limit), "is a different task from")
    return replace(
        task,
        seen=functools.cache(
            lambda: shared(lambda each: each.seen(), "shows states differently from", alike)
        ),
        masks=lambda: shared(lambda each: each.masks(), "masks actions differently from", np.array_equal),
    )


def _batch(env: Any, **bounds: Any) -> Task:
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
        return _copies(env, **bounds)
    if kind == _NATIVE:
        verified(env.mdp, "env")
        limit = env.step_limit if env.step_limit <= MOST_STEPS else None  # what it plays by
        return Task(env.mdp, limit, seen=lambda: make_observation(env.mdp, "none"))
    if kind == _OURS:
        return replace(_batch(env.envs, **bounds), seen=lambda: env.observation)
    below = _batch(env.env if isinstance(env, gym.vector.VectorWrapper) else env.venv, **bounds)
    if kind == _NEUTRAL:
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
        rows = _BY_METHOD[kind](env, below.seen().table())
        return ObservationTable(env.observation_space, below.mdp.num_states, rows)

    return replace(below, seen=seen, normalizer=env if kind == "normalize" and env.norm_obs else None)


def alike(one: ObservationTable, other: ObservationTable) -> bool:
    """Whether all states are shown the same, to the bit."""
    return one.space == other.space and all(
        np.array_equal(mine, theirs) and mine.dtype == theirs.dtype
        for mine, theirs in zip(leaves_of(one.table()), leaves_of(other.table()), strict=True)
    )


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
