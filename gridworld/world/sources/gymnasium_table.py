"""Gymnasium's own environments as worlds, from the transition table that they step by.

Environments of Gymnasium's `toy_text` family have a table `P` and a start distribution:

    P[state][action] = [(probability, next state, reward, terminated), ...]
    initial_state_distrib = (N,) probabilities

Ending belongs to the outcome there; `gridworld.world.outcomes` makes it a state. An environment whose steps
are not those of its table is refused: the real one is walked beside the table, along random actions and along
a good policy, and each step must be an outcome of its row.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gridworld.errors import InputError
from gridworld.world.bellman import backup
from gridworld.world.mdp import IntArray, Mdp
from gridworld.world.outcomes import Outcomes, check_size, mdp_from_outcomes

if TYPE_CHECKING:
    import gymnasium as gym

_SWEEPS = 100  # of value iteration, for the policy of the walk
_GAMMA = 0.99
# The walk: episodes with these shares of random actions in turn. The passenger of a fickle Taxi changes its
# mind in 3 of 10 episodes, on the way to the destination, where random actions do not come.
_RANDOM_SHARES = (0.0, 0.1, 1.0)
_MOST_STEPS = (200, 200, 50)  # of one episode of each
_WALK = 2000  # steps in all
_MOST_EPISODES = 150
_SEED = 20_240_501


def compile_gymnasium(env_id: str, kwargs: Mapping[str, Any] | None = None) -> Mdp:
    """Make an environment of Gymnasium and compile its transition table.

    Args:
        env_id: a registered id, e.g. `FrozenLake-v1`.
        kwargs: arguments of `gymnasium.make`, e.g. `{"is_slippery": False}`.

    Returns:
        The world, with the id as its name and the step limit of the registered id.

    Raises:
        InputError: no such id, arguments that the environment refuses, no table, or an environment that is
            not what its table says.
    """
    arguments = dict(kwargs or {})
    env = _made(env_id, arguments)
    mdp, table = _compiled(env)
    again = _made(env_id, arguments)  # only now: a large environment takes long, and may be refused
    if _differ(table, _table(mdp.name, again.unwrapped)):
        raise InputError(
            f"env.id={env_id}: has another table each time that it is made, so no exact truth is known; "
            "give what it draws as env.kwargs, e.g. desc of a FrozenLake"
        )
    _check_steps(mdp, table, env.unwrapped)
    env.close()
    again.close()
    return mdp


def compile_table(env: gym.Env[Any, Any]) -> Mdp:
    """Compile the transition table of an environment, which is left as it is.

    Args:
        env: an environment with `unwrapped.P` and `unwrapped.initial_state_distrib`. Wrappers count for the
            step limit only.

    Returns:
        The world, with the environment's id as its name, or its class where it has none.

    Raises:
        InputError: no table, or an environment that is not what its table says.
    """
    mdp, table = _compiled(env)
    _check_steps(mdp, table, _copied(env.unwrapped))
    return mdp


def has_table(env: Any) -> bool:
    """Whether an environment has a transition table."""
    return getattr(env, "P", None) is not None


def _made(env_id: str, arguments: dict[str, Any]) -> gym.Env[Any, Any]:
    import gymnasium as gym

    if arguments.get("render_mode") is not None:
        raise InputError(
            f"env.kwargs: render_mode={arguments['render_mode']} is no part of the world; leave it out"
        )
    try:
        spec = gym.spec(env_id)
    except Exception as error:  # an id may name a module, which may raise anything
        raise InputError(
            f"env.id={str(env_id)[:80]}: is no environment that Gymnasium knows ({_told(error)}); give a "
            "registered id, e.g. FrozenLake-v1"
        ) from None
    try:
        with np.errstate(all="ignore"):
            return gym.make(env_id, **{"disable_env_checker": True, **arguments})
    except Exception as error:  # as above
        given = f"env.kwargs={_shown(arguments)}: {env_id}" if arguments else f"env.id={env_id}:"
        takes = _arguments(spec) if arguments else ""
        raise InputError(f"{given} cannot be made ({_told(error)}){takes}") from None


def _told(error: Exception) -> str:
    """What an exception says, in short."""
    text = str(error).split(" was raised from the environment creator")[0].strip().splitlines()
    kind = type(error).__name__
    return f"{kind}: {text[0][:200].rstrip(' .')}" if text else kind


def _shown(arguments: Mapping[str, Any]) -> str:
    return "{" + ", ".join(f"{key}: {value}" for key, value in arguments.items())[:100] + "}"


def _arguments(spec: Any) -> str:
    """What an environment can be made with, as the end of a sentence."""
    from gymnasium.envs.registration import load_env_creator

    try:
        point = spec.entry_point
        parameters = inspect.signature(
            load_env_creator(point) if isinstance(point, str) else point
        ).parameters
    except Exception:
        return "; see its documentation"
    names = [name for name in parameters if name not in ("self", "render_mode")]
    return f"; it takes {', '.join(names)}" if names else "; it takes no arguments"


def _compiled(env: gym.Env[Any, Any]) -> tuple[Mdp, Outcomes]:
    real = env.unwrapped
    name = real.spec.id if real.spec is not None else type(real).__name__
    table = _table(name, real)
    known = _known(real)
    num_states, num_actions = table.next_state.shape[:2]
    names = known.action_names if known is not None and len(known.action_names) == num_actions else None
    places = known.places(real) if known is not None else None
    mdp = mdp_from_outcomes(
        name,
        table,
        action_names=names,
        places=places if places is not None and len(places) == num_states else None,
        panel_names=known.panel_names if known is not None else (),
        max_episode_steps=_step_limit(env),
    )
    if known is not None and (reason := known.refused(real)):
        raise InputError(f"{name}: {reason}")
    return mdp, table


def _step_limit(env: gym.Env[Any, Any]) -> int | None:
    try:
        limit = env.get_wrapper_attr("_max_episode_steps")  # of the wrapper TimeLimit
    except AttributeError:
        return None
    return None if limit is None else int(limit)


def _table(name: str, real: Any) -> Outcomes:
    """P and the start distribution as arrays; an outcome that a row does not have has probability 0."""
    if not has_table(real):
        raise InputError(
            f"{name}: has no transition table P, so its truth cannot be read off; env=enumerated may fit, "
            "which tries out what a deterministic environment does"
        )
    states, actions = (
        _size(name, what, getattr(real, f"{what}_space", None)) for what in ("observation", "action")
    )
    check_size(name, states, actions, 1)
    rows, counts = _rows(name, real.P, states, actions)
    longest = int(counts.max())
    check_size(name, states, actions, longest)

    ends = np.cumsum(counts)
    pair = np.repeat(np.arange(states * actions), counts)
    column = np.arange(len(rows)) - np.repeat(ends - counts, counts)
    # What fills up a short row leads where its first outcome leads, so that it adds no predecessor.
    padded = np.repeat(rows[ends - counts][:, None], longest, axis=1)
    padded[:, :, 0] = 0.0
    padded[pair, column] = rows
    padded = padded.reshape(states, actions, longest, 4)
    return Outcomes(
        next_state=padded[..., 1].astype(np.int64),
        probability=padded[..., 0].copy(),
        reward=padded[..., 2].copy(),
        terminated=padded[..., 3] == 1,
        start=_start(name, real, states),
    )


def _size(name: str, what: str, space: Any) -> int:
    from gymnasium.spaces import Discrete

    if not isinstance(space, Discrete) or space.start != 0:
        raise InputError(f"{name}: its {what} space is {space}, must be Discrete(n) that starts at 0")
    return int(space.n)


def _start(name: str, real: Any, states: int) -> NDArray[np.float64]:
    try:
        start = np.array(getattr(real, "initial_state_distrib", None), dtype=np.float64)
    except (TypeError, ValueError):
        start = np.zeros(0)
    if start.shape != (states,):
        raise InputError(
            f"{name}: initial_state_distrib must be the {states} probabilities of starting in each state"
        )
    return start


def _rows(name: str, table: Any, states: int, actions: int) -> tuple[NDArray[np.float64], IntArray]:
    """All outcomes (M, 4) in the order of states and actions, and how many each of these has (S * A,)."""
    found: list[Any] = []
    counts = np.empty(states * actions, dtype=np.int64)
    try:
        for state in range(states):
            of_state = table[state]
            for action in range(actions):
                row = of_state[action]
                counts[state * actions + action] = len(row)
                found.extend(row)
        rows = np.array(found, dtype=np.float64)
        good = rows.shape == (len(found), 4) and bool((counts > 0).all())
        if good and _are_states(rows[:, 1], states).all() and np.isin(rows[:, 3], (0, 1)).all():
            return rows, counts
    except (KeyError, IndexError, TypeError, ValueError, OverflowError):
        pass
    raise _mistake(name, table, states, actions)


def _are_states(numbers: Any, states: int) -> Any:
    return (numbers >= 0) & (numbers < states) & (np.floor(numbers) == numbers)


def _mistake(name: str, table: Any, states: int, actions: int) -> InputError:
    """The first row that is no row."""
    for state in range(states):
        for action in range(actions):
            try:
                row = table[state][action]
            except (KeyError, IndexError, TypeError):
                return InputError(
                    f"{name}: P has no state {state} with action {action}, must have {states} states with "
                    f"{actions} actions each"
                )
            if not _is_row(row, states):
                return InputError(
                    f"{name}: P[{state}][{action}] is {str(row)[:100]}, must be a list of (probability, next "
                    f"state from 0 to {states - 1}, reward, terminated)"
                )
    return InputError(f"{name}: P is no table of {states} states and {actions} actions")


def _is_row(row: Any, states: int) -> bool:
    try:
        numbers = np.array(list(row), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return False
    if numbers.ndim != 2 or numbers.shape[1] != 4 or not len(numbers):
        return False
    return bool(_are_states(numbers[:, 1], states).all() and np.isin(numbers[:, 3], (0, 1)).all())


def _differ(table: Outcomes, other: Outcomes) -> bool:
    names = ("next_state", "probability", "reward", "terminated", "start")
    return not all(np.array_equal(getattr(table, name), getattr(other, name)) for name in names)


def _copied(real: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """An environment to walk in, with a generator of its own, which opens no window."""
    from gymnasium.utils import seeding

    try:
        other = copy.deepcopy(real)
    except Exception:  # a window, say; what a step sets anew is the copy's own all the same
        other = copy.copy(real)
    other.render_mode = None
    other.np_random = seeding.np_random(_SEED)[0]
    return other


def _check_steps(mdp: Mdp, table: Outcomes, real: gym.Env[Any, Any]) -> None:
    mistake = None
    try:
        _walk(mdp, table, real)
    except InputError as error:
        mistake = error
    except Exception as error:  # an environment of the user's own may raise anything
        raise InputError(f"{mdp.name}: cannot be stepped ({_told(error)})") from error
    if _differ(table, _table(mdp.name, real)):
        raise InputError(
            f"{mdp.name}: its table P changes when it is reset or stepped, so no exact truth is known; must "
            "stay what it is from when the environment was made"
        )
    if mistake is not None:
        raise mistake


def _walk(mdp: Mdp, table: Outcomes, real: gym.Env[Any, Any]) -> None:
    """Compare steps of the real environment with the table, for episodes of `_WALK` steps in all."""
    policy = _good_policy(mdp)
    rng = np.random.default_rng(_SEED)
    steps = 0
    for episode in range(_MOST_EPISODES):
        share, most = _RANDOM_SHARES[episode % 3], _MOST_STEPS[episode % 3]
        state = _number(mdp, real.reset(seed=_SEED if episode == 0 else None)[0])
        if not table.start[state] > 0:
            raise InputError(
                f"{mdp.name}: started in state {state}, which has no probability in initial_state_distrib"
            )
        for _ in range(most):
            action = int(rng.integers(mdp.num_actions) if rng.random() < share else policy[state])
            observation, reward, terminated, truncated, _ = real.step(action)
            following = _number(mdp, observation)
            _check_step(mdp.name, table, (state, action), (following, float(reward), bool(terminated)))
            if truncated:
                raise InputError(
                    f"{mdp.name}: cuts its episodes by itself, which its table P does not have; must leave "
                    "that to the wrapper TimeLimit"
                )
            steps += 1
            if terminated:
                break
            state = following
        if steps >= _WALK:
            break


def _good_policy(mdp: Mdp) -> IntArray:
    """(S,), an optimal action of each state, up to what `_SWEEPS` of value iteration leave open."""
    v = np.zeros(mdp.num_states)
    for _ in range(_SWEEPS):
        q = backup(mdp, v, _GAMMA)
        v = q.max(axis=1)
    return np.asarray(q.argmax(axis=1))


def _number(mdp: Mdp, observation: Any) -> int:
    number = int(observation)
    if not 0 <= number < mdp.num_numbers:
        raise InputError(f"{mdp.name}: shows state {number}, its table has states 0 to {mdp.num_numbers - 1}")
    return number


def _check_step(name: str, table: Outcomes, pair: tuple[int, int], found: tuple[int, float, bool]) -> None:
    following, reward, terminated = found
    same = (table.next_state[pair] == following) & (table.reward[pair] == reward)
    if not (same & (table.terminated[pair] == terminated) & (table.probability[pair] > 0)).any():
        state, action = pair
        raise InputError(
            f"{name}: leaves its own table: in state {state}, action {action} led to state {following} with "
            f"reward {reward:g}{' and ended' if terminated else ''}, which P[{state}][{action}] does not "
            "have, so no exact truth is known; must step by P alone"
        )


@dataclass(frozen=True)
class _Known:
    """What is known of a class of environments beside its table."""

    action_names: tuple[str, ...]
    places: Callable[[Any], NDArray[np.int64]]  # (N, 3), see `Mdp`
    panel_names: tuple[str, ...] = ()  # see `Mdp`
    refused: Callable[[Any], str] = lambda env: ""  # why its table is not true, if that can be seen


def _grid_places(rows: int, cols: int) -> NDArray[np.int64]:
    row, col = np.divmod(np.arange(rows * cols), cols)
    return np.stack([np.zeros_like(row), row, col], axis=1).astype(np.int64)


def _taxi_places(env: Any) -> NDArray[np.int64]:
    """One panel for each passenger and destination: passenger * 4 + destination."""
    cell, panel = np.divmod(np.arange(500), 20)
    return np.stack([panel, cell // 5, cell % 5], axis=1).astype(np.int64)


def _is_fickle(env: Any) -> str:
    if not (getattr(env, "fickle_passenger", False) and getattr(env, "fickle_probability", 1) > 0):
        return ""
    return (
        "fickle_passenger=True changes the destination in a way that its table P does not have, so no exact "
        "truth is known; leave it out"
    )


_KNOWN = {
    "FrozenLakeEnv": _Known(("left", "down", "right", "up"), lambda env: _grid_places(*env.desc.shape)),
    "CliffWalkingEnv": _Known(("up", "right", "down", "left"), lambda env: _grid_places(*env.shape)),
    "TaxiEnv": _Known(
        ("south", "north", "east", "west", "pickup", "dropoff"),
        _taxi_places,
        tuple(f"{passenger} to {destination}" for passenger in (*"RGYB", "taxi") for destination in "RGYB"),
        refused=_is_fickle,
    ),
}


def _known(real: Any) -> _Known | None:
    for each in type(real).__mro__:
        if each.__module__.startswith("gymnasium.envs.toy_text."):
            return _KNOWN.get(each.__name__)
    return None
