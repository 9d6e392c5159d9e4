"""A real environment beside its transition table: along random actions and along a good policy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gridworld.errors import InputError
from gridworld.world.exact.bellman import backup
from gridworld.world.mdp import IntArray, Mdp
from gridworld.world.outcomes import Outcomes

if TYPE_CHECKING:
    import gymnasium as gym

SEED = 20_240_501  # of the walk
_SWEEPS = 100  # of value iteration, for the policy of the walk
_GAMMA = 0.99
# The walk: episodes with these shares of random actions in turn. The passenger of a fickle Taxi changes its
# mind in 3 of 10 episodes, on the way to the destination, where random actions do not come.
_RANDOM_SHARES = (0.0, 0.1, 1.0)
_MOST_STEPS = (200, 200, 50)  # of one episode of each
_WALK = 2000  # steps in all
_MOST_EPISODES = 150


def walk(mdp: Mdp, table: Outcomes, real: gym.Env[Any, Any]) -> None:
    """Compare steps of the real environment with its table, in episodes of 2,000 steps together.

    Args:
        mdp: the world that was made of the table.
        table: what the environment says of itself.
        real: the environment with its wrappers, which is stepped.

    Raises:
        InputError: a start or a step that the table does not have.
    """
    policy = _good_policy(mdp)
    rng = np.random.default_rng(SEED)
    steps = 0
    for episode in range(_MOST_EPISODES):
        share, most = _RANDOM_SHARES[episode % 3], _MOST_STEPS[episode % 3]
        state = _number(mdp, real.reset(seed=SEED if episode == 0 else None)[0])
        if not table.start[state] > 0:
            raise InputError(
                f"{mdp.name}: started in state {state}, which has no probability in initial_state_distrib"
            )
        for step in range(most):
            action = int(rng.integers(mdp.num_actions) if rng.random() < share else policy[state])
            observation, reward, terminated, truncated, _ = real.step(action)
            following = _number(mdp, observation)
            _check_step(mdp.name, table, (state, action), (following, float(reward), bool(terminated)))
            if truncated and step + 1 < (mdp.max_episode_steps or np.inf):
                raise InputError(
                    f"{mdp.name}: cuts its episodes by itself, which its table P does not have; must leave "
                    "that to the wrapper TimeLimit"
                )
            steps += 1
            if terminated or truncated:
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
    try:
        number = int(observation)
        is_number = bool(number == observation)
    except (TypeError, ValueError, OverflowError):
        is_number = False
    if not is_number:
        raise InputError(
            f"{mdp.name}: shows {str(observation)[:80]!r}, must show the number of a state of its table"
        )
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
