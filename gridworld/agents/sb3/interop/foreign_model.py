"""Reading any model of SB3 as a policy over the states of a world, whoever trained it.

The greedy policy is what `predict` does on what the environment shows of each state, with the action masks of
that environment. What it explores with is read from its network.
"""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.policies import BasePolicy

from gridworld.agents.sb3.memory_size import CHUNK
from gridworld.agents.sb3.policy_outputs import (
    Reading,
    read,
    read_states,
    why_no_table,
    why_unreadable,
)
from gridworld.envs.inspection import Task, observation_like, tabulated, task_of
from gridworld.envs.observations import KINDS, ObservationTable
from gridworld.errors import InputError, in_short
from gridworld.world.exact.markov_chain import one_hot_policy
from gridworld.world.mdp import FloatArray, IntArray
from gridworld.world.sources.pure_functions import same
from gridworld.world.sources.snapshots import random_states
from gridworld.world.sources.wrappers import is_discrete

_LIBRARIES = ("stable_baselines3.", "sb3_contrib.", "gridworld.")
_ONE_BY_ONE = 512  # states in which `predict` is asked alone, too
_OFTEN = 100  # times, where `predict` is of its own
_PREDICTS = ("predict", "_predict")  # what decides an action, of a model or a policy


class Tables(NamedTuple):
    """A model's policies, and what they are of; (S, A), float64, each."""

    greedy: FloatArray  # action probabilities
    sampled: FloatArray | None  # the same; None: its own `predict` decides, which shows no probabilities
    outputs: FloatArray  # action probabilities of an actor-critic, Q values of others


class ForeignPolicy:
    """A model's policy in a task.

    Args:
        model: an SB3 model, or its policy.
        task: the task, whose observations are asked for anew at every reading, since statistics may change.
    """

    def __init__(self, model: Any, task: Task) -> None:
        self._model, self._task, self._policy = model, task, _policy_of(model)
        self._guess_is_fine = False
        if not is_discrete(self._policy.action_space, task.mdp.num_actions):
            raise InputError(
                f"the model acts in {self._policy.action_space}; {task.mdp.name} has "
                f"Discrete({task.mdp.num_actions})"
            )
        reason = why_unreadable(self._policy)
        if reason is not None:
            raise InputError(f"the model {reason}")
        predicts = (model.predict, self._policy.predict)
        takes_masks = any("action_masks" in inspect.signature(each).parameters for each in predicts)
        self._masks = task.masks() if takes_masks else None
        self._check_is_a_table(self._observation())

    def tables(self) -> Tables:
        """Ask it about every state. It is left as it was."""
        observation = self._observation()
        was_training = self._policy.training
        _, probabilities, q = read_states(
            observation.num_states, lambda states: self._read(observation, states)
        )
        outputs = q if probabilities is None else probabilities
        assert outputs is not None
        if not np.isfinite(outputs).all():
            raise InputError("the model's outputs are no finite numbers; its training has diverged")
        greedy = one_hot_policy(self._predicted(observation), outputs.shape[1])
        self._policy.set_training_mode(was_training)
        epsilon = float(getattr(self._model, "exploration_rate", 0.0))
        sampled = outputs if q is None else (1 - epsilon) * greedy + epsilon / outputs.shape[1]
        return Tables(greedy, sampled if self._is_of_a_library() else None, outputs)

    def _observation(self) -> ObservationTable:
        """What it sees of each state: what the task shows, or the world's own observation with its space."""
        seen, wanted = None if self._task.seen is None else self._task.seen(), self._policy.observation_space
        if seen is not None and seen.space != wanted and _is_transposed(seen.space, wanted):
            return tabulated(wanted, seen.table().transpose(0, 3, 1, 2), seen.num_states)
        if seen is not None and seen.space == wanted:
            if isinstance(seen.stored, dict):
                raise InputError(
                    "env: its observations are a Dict; take one entry, as VecExtractDictObs does"
                )
            return seen
        if seen is not None and seen.kind not in KINDS:
            raise InputError(
                f"the model sees {wanted}, and the environment shows {seen.space}; give the environment that "
                "the model was trained on, as model.get_env() has it"
            )
        guess = observation_like(self._task.mdp, wanted)
        self._check_guess(guess)
        return guess

    def _check_guess(self, guess: ObservationTable) -> None:
        """Refuse an observation that only has the right space, where the model was shown another one."""
        env = getattr(self._model, "get_env", lambda: None)()
        if env is None or self._guess_is_fine:
            return
        try:
            task = task_of(env)
            shown = None if task.seen is None else task.seen()
        except InputError as error:
            raise InputError(
                "the model: what it was shown in training is not known, so it cannot be scored on an "
                f"environment that shows something else; give one that shows the same ({error})"
            ) from None
        is_ours = shown is not None and shown.kind in KINDS
        alike = shown is not None and shown.space == guess.space and same(shown.table(), guess.table())
        if not is_ours and not alike:
            raise InputError(
                f"the model was shown observations of its own in training, and {guess.kind} of this world "
                "only has the same space; give an environment with the wrappers that it was trained on"
            )
        self._guess_is_fine = True

    def _read(self, observation: ObservationTable, states: IntArray) -> Reading:
        rows = self._policy.obs_to_tensor(observation.rows(states))[0]
        return read(self._policy, rows, None if self._masks is None else self._masks[states])

    def _predicted(self, observation: ObservationTable) -> IntArray:
        """(S,), the actions that `predict` takes, asked in batches."""
        parts = [
            self._predict(observation, np.arange(start, min(start + CHUNK, observation.num_states)))
            for start in range(0, observation.num_states, CHUNK)
        ]
        return np.concatenate(parts)

    def _predict(self, observation: ObservationTable, states: IntArray) -> IntArray:
        """(n,), the actions of some states; `states` is one number to ask as for a single environment."""
        masks = {} if self._masks is None else {"action_masks": self._masks[states]}
        try:
            found = self._model.predict(observation.rows(states), deterministic=True, **masks)
            actions, state = np.asarray(found[0]), found[1]
        except Exception as error:  # it may be anybody's own
            raise InputError(f"the model: its predict() raised {in_short(error)}") from error
        if state is not None:
            raise InputError(
                "the model: its predict() gives a state to give back, so what it does is not a function of "
                "the observation, and no table of it can be evaluated exactly"
            )
        fits = actions.shape == np.shape(states) and actions.dtype.kind in "iu"
        if not fits or not np.isin(actions, np.arange(self._task.mdp.num_actions)).all():
            raise InputError(
                f"the model: its predict() gave {str(actions)[:60]} for {np.size(states)} states; must be an "
                f"action of each, {self._task.mdp.action_choices()}"
            )
        return actions

    def _check_is_a_table(self, observation: ObservationTable) -> None:
        was_training, before = self._policy.training, random_states()
        reached = np.flatnonzero(self._task.mdp.acting)[:_ONE_BY_ONE]
        together = self._predicted(observation)[reached]
        rounds = [np.array([self._predict(observation, state) for state in reached])]
        rounds += [
            self._predicted(observation)[reached] for _ in range(1 if self._is_of_a_library() else _OFTEN)
        ]
        reason = why_no_table(self._policy, observation)
        self._policy.set_training_mode(was_training)
        if reason is None and random_states() != before:
            reason = "draws random numbers for its best action, so no table of it can be evaluated exactly"
        if reason is None and any((each != together).any() for each in rounds):
            reason = (
                "does not always take the same action in the same state, asked alone and with others, so no "
                "table of it can be evaluated exactly"
            )
        if reason is not None:
            raise InputError(f"the model {reason}")

    def _is_of_a_library(self) -> bool:
        """Whether it acts by SB3's own `predict`, so that its network says what it explores with."""
        modules = [type(each).__module__ for each in self._policy.modules()]
        if not all(module.startswith((*_LIBRARIES, "torch.")) for module in modules):
            return False
        for thing in (self._model, self._policy):
            for name in _PREDICTS:
                method = getattr(type(thing), name, None)
                is_own = method is not None and not method.__module__.startswith(_LIBRARIES)
                if is_own or name in vars(thing):
                    return False
        return True


def tables_of(model: Any, task: Task) -> Tables:
    """Read a model's policies once; see `ForeignPolicy`."""
    return ForeignPolicy(model, task).tables()


def _is_transposed(shown: Any, wanted: Any) -> bool:
    """Whether images are shown with their channels last, which `predict` takes too."""
    shape: tuple[int, ...] = shown.shape or ()
    is_image = len(shape) == 3 and shown.dtype == wanted.dtype == np.uint8
    return is_image and (shape[2], *shape[:2]) == wanted.shape


def _policy_of(model: Any) -> BasePolicy:
    policy = model if isinstance(model, BasePolicy) else getattr(model, "policy", None)
    if not isinstance(policy, BasePolicy):
        raise InputError(f"{type(model).__name__}: is neither a model of Stable-Baselines3 nor a table")
    return policy
