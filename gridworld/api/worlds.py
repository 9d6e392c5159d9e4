"""Custom worlds and policies: a policy's exact score, an environment's tables, and tables as a batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from typing import Any

import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import ArrayLike

from gridworld.base.bounds import Discount
from gridworld.base.errors import InputError, on_a_line
from gridworld.config.compose import named_world
from gridworld.config.worlds import is_id
from gridworld.envs.inspection import Task, task_of, world_of
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.world.door.budget import MOST_SECONDS, MOST_STATES
from gridworld.world.evaluation import Evaluator, PolicySnapshot, Score, as_numbers, policy_of_table
from gridworld.world.mdp import FloatArray, Mdp
from gridworld.world.sources.environment import make_env


def evaluate(
    model_or_table: Any = None,
    env: Any = None,
    gamma: float | None = None,
    *,
    q: ArrayLike | None = None,
    deterministic: bool = True,
    max_episode_steps: int | None = None,
) -> Score:
    """Score a policy exactly: no episodes are played, and the score has no noise.

    Args:
        model_or_table: a model of SB3 or of any library with its interface (DQN, PPO, A2C, QRDQN, TRPO, ...),
            or its policy, which acts as its `predict` does, with the environment's `action_masks()` if it
            takes them; a finished run, or its `policy`; or a table: actions (S,), whole numbers from 0, or
            their probabilities (S, A); by observations where the environment shows whole numbers.
        env: an environment of Gymnasium with all its wrappers, a class or a function that makes one, or a
        batch
            of Gymnasium or SB3; a compiled world (`compile_mdp`, `compile_env`); a finished run; what
            `env=NAME` means on a command line, or an id of Gymnasium; or a map, its file or a `Layout`.
            What all layers of an environment hold is its state, see `gridworld.world.door`; it is left as
            it was. A model sees states as this environment shows them; where that is the world's own
            observation of another kind, by the kind that has the model's observation space. None: the
            environment that the model or run was trained on.
        gamma: discount of value and regret; None: 0.99, or a run's own `evaluation.gamma`.
        q: in place of `model_or_table`: Q values (S, A), of which the first of the best actions is taken.
        deterministic: whether to score a model's best action in every state, or the distribution that it
            explores with, as SB3's `evaluate_policy` does.
        max_episode_steps: step limit of an episode; None: the environment's own, or 100.

    Returns:
        Its `value`, `regret`, `certified`, `proven_regret` where that is small, and the `outcome` of an
        episode, which has the probabilities of `goal`, `trap` and `timeout`, `expected_return` and
        `expected_length`.

    Raises:
        InputError: no world that is known exactly; a table
            that does not fit it; a model that keeps a memory, or sees or does something else.

    Example:
        >>> evaluate([1] * 30, "classic").regret > 0.9  # always to the right
        True
        >>> import gymnasium
        >>> round(evaluate([1] * 16, gymnasium.make("FrozenLake-v1")).outcome.goal, 3)  # always down
        0.049
    """
    if (model_or_table is None) == (q is None):
        raise InputError("evaluate: give either a model or table as the first argument, or q=...")
    if isinstance(getattr(model_or_table, "evaluator", None), Evaluator):  # a run
        env = model_or_table if env is None else env
        model_or_table = model_or_table.policy
    name = "the table" if q is None else "q"
    if isinstance(model_or_table, PolicySnapshot):
        name = "the run's policy"
        model_or_table = model_or_table.greedy if deterministic else model_or_table.sampled
    is_model = hasattr(model_or_table, "observation_space")
    place = model_or_table.get_env() if env is None and hasattr(model_or_table, "get_env") else env
    if place is None and isinstance(model_or_table, str | PathLike):
        raise InputError(f"evaluate: {model_or_table} is a path; open the run with open_run(path) first")
    if place is None:
        raise InputError("env: is required; give an environment, a compiled world or the name of a world")
    if isinstance(place, str):
        place = named_world(place)
    elif isinstance(evaluator := getattr(place, "evaluator", None), Evaluator):  # a run
        gamma = evaluator.solution.gamma if gamma is None else gamma
        place = replace(evaluator.mdp, max_episode_steps=evaluator.max_episode_steps)
    gamma = 0.99 if gamma is None else gamma
    Discount().check("gamma", gamma)
    task = task_of(place, max_episode_steps)
    mdp, limit = task.mdp, task.max_episode_steps
    if is_model:
        from gridworld.agents.sb3.exact_eval import ForeignPolicy  # here, since it imports torch

        tables = ForeignPolicy(model_or_table, task).tables()
        if tables.sampled is None and not deterministic:
            raise InputError(
                f"{type(model_or_table).__name__}: has its own predict(), so its exploring distribution is "
                "unknown; use deterministic=True"
            )
        policy = tables.greedy if deterministic or tables.sampled is None else tables.sampled
    else:
        numbers = as_numbers(name, model_or_table if q is None else q, "a model, an opened run")
        if np.isnan(numbers).any():
            raise InputError(f"{name}: contains NaN")
        policy = policy_of_table(mdp, name, _by_states(task, numbers), is_q=q is not None)
    return Evaluator(mdp, gamma, limit).score(policy)


def _by_states(task: Task, numbers: FloatArray) -> FloatArray:
    """The rows of a table that is by what is shown: two states may look alike, or be renumbered."""
    mdp = task.mdp
    if not numbers.ndim:
        return numbers
    if task.is_found and task.seen is not None:
        seen = task.seen()
        if not isinstance(seen.space, Discrete):
            raise InputError(
                f"the table: {mdp.name} shows {on_a_line(seen.space)}, by which no table has rows; give "
                "a model, or "
                "a table by the "
                "states of compile_env(env)"
            )
        if len(numbers) != seen.space.n:
            raise InputError(
                f"the table: has {len(numbers)} rows; {mdp.name} shows {on_a_line(seen.space)}, so it "
                "must have "
                f"{seen.space.n}"
            )
        return np.asarray(numbers[seen.table() - seen.space.start])
    is_by_number = len(numbers) == mdp.num_numbers < mdp.num_states
    return np.asarray(numbers[mdp.number]) if is_by_number else numbers


def compile_env(
    env: Any,
    *,
    state: Callable[[Any], Any] | None = None,
    ignore: Sequence[str] = (),
    most_states: int = MOST_STATES,
    most_seconds: float = MOST_SECONDS,
) -> Mdp:
    """Compile an environment into the tables of its world. The environment is left as it is.

    Args:
        env: an environment of Gymnasium with all its wrappers, a class or a function that makes one, or a
            batch of Gymnasium or SB3. A GridWorld, and FrozenLake, CliffWalking and Taxi by their transition
            tables, are known; of any other, every action is tried in a copy of every state. Or a name: what
            `env=NAME` means on a command line, an id of Gymnasium, or `module:NAME`.
        state: a function of the environment without wrappers that returns all that matters of its state, by
            your word; None: what the attributes of all layers hold.
        ignore: names of attributes that are not part of its state, by your word.
        most_states: a search that finds more is refused.
        most_seconds: a search that takes longer is refused.

    Returns:
        The world, with the environment's step limit as `max_episode_steps`; a GridWorld's own world. Its
        `truth` says how the tables are known.

    Raises:
        InputError: its states are too many or continuous, it does not follow its own table, or it depends on
            more than its attributes and `np_random`.

    Example:
        >>> import gymnasium
        >>> mdp = compile_env(gymnasium.make("FrozenLake-v1"))
        >>> mdp.name, mdp.num_states, mdp.action_names, mdp.max_episode_steps
        ('FrozenLake-v1', 16, ('left', 'down', 'right', 'up'), 100)
    """
    if isinstance(env, str) and not is_id(env):
        if ignore or state is not None:
            raise InputError(f"env={env}: is a world with tables of its own; leave out state= and ignore=")
        return named_world(env)
    if isinstance(ignore, str):
        raise InputError(f"ignore={ignore!r}: must be a list of names, [{ignore!r}]")
    given = partial(make_env, env) if isinstance(env, str) else env
    bounds = {"most_states": most_states, "most_seconds": most_seconds}
    return world_of(given, state=state, ignore=ignore, **bounds)


def make_vec(mdp: Mdp, num_envs: int = 1, **kwargs: Any) -> GridWorldVectorEnv:
    """Make a batch of environments on one world, as Gymnasium's `make_vec` does for an id.

    An observation is a state. The source's own observation of it is `mdp.number[state]`, which is the same
    but for further ends, see `gridworld.world.outcomes`.

    Args:
        mdp: the world.
        num_envs: how many.
        kwargs: further arguments of `GridWorldVectorEnv`. Without `max_episode_steps`, the step limit is the
            world's own, or none; of a map, 100.

    Raises:
        InputError: no world, or arguments that make no batch.

    Example:
        >>> import gymnasium
        >>> env = make_vec(compile_env(gymnasium.make("Taxi-v4")), num_envs=1000)
        >>> states, _ = env.reset(seed=0)
        >>> states, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
    """
    if not isinstance(mdp, Mdp):
        raise InputError(f"mdp={str(mdp)[:50]}: must be a compiled world, as from `compile_env`")
    kwargs.setdefault("max_episode_steps", mdp.default_step_limit)
    return GridWorldVectorEnv(num_envs, mdp=mdp, **kwargs)
