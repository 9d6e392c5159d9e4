"""What the wrappers of an environment make of its world.

Every wrapper is looked at, and recognised by whose `step` and `reset` it runs:

    neutral      leaves the task as it is: it records, checks or renders
    time limit   its limit is the world's
    observation  `observation(o)`, asked for what the agent sees of each state
    reward       `reward(r)`, compiled into the rewards
    action       `action(a)`, compiled into the transitions
    memory       shows more than the state's number; the task is the same, but a policy behind it has no table

Anything else is refused. The three methods must be functions of their argument alone (`reach.asked`); a copy
is stepped beside the tables for a while.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray

from gridworld.base.errors import InputError, in_short
from gridworld.world.mdp import Mdp, backup, checked_reward, frozen
from gridworld.world.outcomes import absorbing_states, thresholds_of
from gridworld.world.reach import SO_UNKNOWN, Reach, asked, same
from gridworld.world.solver import swept_values

NEUTRAL, LIMIT, MEMORY = "neutral", "time limit", "memory"
_STEPS, _MASKED_STEPS = 500, 2000  # of the copy beside the tables
_GAMMA = 0.99
_SEED = 20_261_123

_ROLES = {
    "gymnasium.core:Wrapper": NEUTRAL,  # of a wrapper that changes neither steps nor resets
    "gymnasium.core:ObservationWrapper": "observation",
    "gymnasium.core:RewardWrapper": "reward",
    "gymnasium.core:ActionWrapper": "action",
    "stable_baselines3.common.monitor:Monitor": NEUTRAL,
    "gymnasium.wrappers.common:TimeLimit": LIMIT,
}
for _module, _names, _role in (
    ("common", "Autoreset OrderEnforcing PassiveEnvChecker RecordEpisodeStatistics", NEUTRAL),
    ("rendering", "AddWhiteNoise HumanRendering ObstructView RecordVideo RenderCollection", NEUTRAL),
    ("transform_observation", "AddRenderObservation", MEMORY),
    ("stateful_observation", "DelayObservation FrameStackObservation", MEMORY),
    ("stateful_observation", "NormalizeObservation TimeAwareObservation", MEMORY),
):
    _ROLES |= {f"gymnasium.wrappers.{_module}:{_name}": _role for _name in _names.split()}
STEPPED_BY = ("step", "reset", "env", "unwrapped", "__getattribute__")  # who overrides one may do anything
# Environments whose state can be set, by the class whose steps they run.
_STATE_ATTRIBUTES = {
    "gridworld.envs.env:GridWorldEnv": "state",
    "gymnasium.envs.toy_text.frozen_lake:FrozenLakeEnv": "s",
    "gymnasium.envs.toy_text.cliffwalking:CliffWalkingEnv": "s",
    "gymnasium.envs.toy_text.taxi:TaxiEnv": "s",
}


def wrappers_of(env: Any) -> Iterator[gym.Wrapper[Any, Any, Any, Any]]:
    """The wrappers of an environment, from the outside."""
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env


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


def role_of(where: str, wrapper: gym.Wrapper[Any, Any, Any, Any]) -> str:
    """What a wrapper does, as in `_ROLES`; refuses one that may do anything."""
    name, role = type(wrapper).__name__, known_class(wrapper, _ROLES, STEPPED_BY)
    if role is None:
        raise InputError(
            f"{where}: its wrapper {name} has its own step() or reset(), or changes access to them, so it "
            "cannot be solved exactly; leave it out, or make it a gymnasium ObservationWrapper, "
            "RewardWrapper or ActionWrapper that defines only observation(), reward() or action()"
        )
    for what, changing in (("observation", ("observation", MEMORY)), ("action", ("action",))):
        inner, outer = (getattr(each, f"{what}_space") for each in (wrapper.env, wrapper))
        if outer != inner and role not in changing:
            raise InputError(
                f"{where}: its wrapper {name} changes the {what} space but is not a "
                f"gymnasium.{what.title()}Wrapper, so its effect is unknown; make it one"
            )
    return role


def refuse_transformed(where: str, env: gym.Env[Any, Any]) -> None:
    """Refuse an environment whose wrappers change its task or what is seen of it."""
    for wrapper in wrappers_of(env):
        if (role := role_of(where, wrapper)) not in (NEUTRAL, LIMIT):
            changed = "observation" if role == MEMORY else role
            raise InputError(
                f"{where}: its wrapper {type(wrapper).__name__} changes {changed}s, so the known "
                "environment below it is not what the agent is in; leave it out"
            )


def step_limit(env: gym.Env[Any, Any]) -> int | None:
    """The least step limit of an environment's wrappers; None: there is none."""
    found = [each for each in wrappers_of(env) if isinstance(each, gym.wrappers.TimeLimit)]
    return min((int(vars(each)["_max_episode_steps"]) for each in found), default=None)


class Wrapped:
    """The world of an environment as it is through its wrappers; the environment is left as it is.

    `mdp` is the world below all wrappers, which shows its state's number.
    """

    def __init__(self, where: str, env: gym.Env[Any, Any], mdp: Mdp) -> None:
        self._where, self._env, self._bare = where, env, mdp
        self._attribute = known_class(env.unwrapped, _STATE_ATTRIBUTES, STEPPED_BY)
        roles = [(wrapper, role_of(where, wrapper)) for wrapper in list(wrappers_of(env))[::-1]]
        self.memory = [type(wrapper).__name__ for wrapper, role in roles if role == MEMORY]
        self.transforms = [wrapper for wrapper, role in roles if role in ("observation", "reward", "action")]
        changing = [type(wrapper).__name__ for wrapper, role in roles if role in ("reward", "action")]
        self.mdp = mdp
        if changing:
            for wrapper in self.transforms:
                if isinstance(wrapper, gym.RewardWrapper):
                    self.mdp = self._paid(self.mdp, wrapper)
                elif isinstance(wrapper, gym.ActionWrapper):
                    self.mdp = self._acted(self.mdp, wrapper)
            self.mdp = replace(self.mdp, name=f"{mdp.name} in {', '.join(changing)}")
            self._check_steps(lambda number, observation: None)

    @cached_property
    def observations(self) -> list[Any]:
        """What an agent sees of each state: S of them, arrays or of any other kind."""
        if self.memory:
            raise InputError(
                f"{self._where}: {self.memory[0]} makes observations that depend on more than the state, so "
                "no policy can be evaluated exactly; leave it out"
            )
        rows: list[Any] = self._bare.number.tolist()

        def compare(number: int, observation: Any) -> None:
            if not same(rows[number], observation):
                raise InputError(
                    f"{self._where}: its wrappers do not always show the same of state {number}{SO_UNKNOWN}"
                )

        if self.transforms:
            for wrapper in self.transforms:
                if isinstance(wrapper, gym.ObservationWrapper):
                    rows = asked(self._where, wrapper, "observation", rows)
            self._check_steps(compare)
        return rows

    @cached_property
    def action_masks(self) -> NDArray[np.bool_] | None:
        """What `action_masks()` of the environment allows, (S, A); None: there is none."""
        if not self._env.has_wrapper_attr("action_masks"):
            return None
        env = self._copied
        masks, chain = env.get_wrapper_attr("action_masks"), [*wrappers_of(env), env.unwrapped]
        if self._attribute is None:
            raise InputError(
                f"{self._where}: action_masks() is not available for each state, since the state of "
                f"{type(env.unwrapped).__name__} cannot be set; use a model without masks"
            )
        within = {
            each: Reach(self._where, each, "action_masks", chain)
            for each in chain
            if hasattr(each, "action_masks")
        }

        def contents() -> list[bytes]:
            return [reach.content(is_outside=each is env.unwrapped) for each, reach in within.items()]

        for wrapper in self._left_out:
            own = vars(wrapper).keys() - vars(gym.Wrapper(wrapper.env)).keys()
            if read := {name for each in within.values() for name in each.names & own}:
                raise InputError(
                    f"{self._where}: action_masks() reads {min(read)} of {type(wrapper).__name__}{SO_UNKNOWN}"
                )
        before, found = contents(), np.ones((self._bare.num_states, self.mdp.num_actions), dtype=np.bool_)
        for state in np.flatnonzero(self._bare.acting).tolist():
            setattr(env.unwrapped, self._attribute, int(self._bare.number[state]))
            with self._refusing("action_masks() failed"):
                found[state] = masks()
                if contents() != before:
                    raise InputError(f"{self._where}: action_masks() keeps memory{SO_UNKNOWN}")

        def compare(number: int, observation: Any) -> None:
            if self._bare.acting[number] and not np.array_equal(found[number], masks()):
                raise InputError(
                    f"{self._where}: action_masks() does not always allow the same in state {number}"
                    f"{SO_UNKNOWN}"
                )

        self._check_steps(compare, _MASKED_STEPS)
        return found

    @cached_property
    def _copied(self) -> gym.Env[Any, Any]:
        """A copy of the environment to step: of its wrappers only those that transform, and custom ones."""
        env: Any = _Probe(copied(self._env.unwrapped))
        self._probe, seen = env, {id(self._env.unwrapped): env.unwrapped}
        self._left_out: list[Any] = []
        for wrapper in list(wrappers_of(self._env))[::-1]:
            kind = type(wrapper)
            is_custom = kind.step is gym.Wrapper.step and kind.reset is gym.Wrapper.reset
            if wrapper in self.transforms or is_custom:
                try:
                    other = copy.deepcopy(wrapper, seen)
                except Exception as error:
                    raise InputError(
                        f"{self._where}: its wrapper {kind.__name__} cannot be copied ({in_short(error)}), "
                        "so its effect cannot be determined; leave it out"
                    ) from None
                other.env, env = env, other
            else:
                self._left_out.append(wrapper)
            seen[id(wrapper)] = env
        with self._refusing("cannot be reset"):
            env.reset()
        return env  # type: ignore[no-any-return]

    @contextmanager
    def _refusing(self, what: str) -> Iterator[None]:
        """One sentence for whatever somebody's code raises."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{self._where}: {what} ({in_short(error)})") from error

    def _paid(self, mdp: Mdp, wrapper: Any) -> Mdp:
        """The world with a wrapper's rewards; an end pays nothing, nor does a state without a way to it."""
        counts = (mdp.probability > 0) & (~mdp.absorbing | mdp.reachable & ~mdp.terminal)[:, None, None]
        given, what = np.unique(mdp.reward[counts]), f"{self._where}: a reward of {type(wrapper).__name__}"
        paid = [_plain(reward) for reward in asked(self._where, wrapper, "reward", given.tolist())]
        made = np.array([checked_reward(what, each) for each in paid])
        reward = np.zeros(mdp.reward.shape)
        reward[counts] = made[np.searchsorted(given, mdp.reward[counts])]
        return _changed(mdp, reward=reward)

    def _acted(self, mdp: Mdp, wrapper: Any) -> Mdp:
        """The world with a wrapper's actions."""
        space, name = wrapper.action_space, type(wrapper).__name__
        if not is_discrete(space, getattr(space, "n", -1)):
            raise InputError(f"{self._where}: the actions of {name} are {space}; must be Discrete(n) from 0")
        chosen = [_plain(each) for each in asked(self._where, wrapper, "action", list(range(int(space.n))))]
        for action, inner in enumerate(chosen):
            if not isinstance(inner, int) or inner not in range(mdp.num_actions):
                raise InputError(
                    f"{self._where}: {name} turns action {action} into {str(inner)[:50]}; must be "
                    f"{mdp.action_choices()}"
                )
        tables = ("next_state", "probability", "reward")
        chosen_tables = {key: getattr(mdp, key)[:, np.array(chosen, dtype=int)] for key in tables}
        return _changed(mdp, action_names=tuple(mdp.action_names[each] for each in chosen), **chosen_tables)

    def _check_steps(self, compare: Callable[[int, Any], None], steps: int = _STEPS) -> None:
        """Step the copy beside the tables, along good and random ways.

        `compare` is called with every number and what is seen of it.
        """
        env, probe, rng = self._copied, self._probe, np.random.default_rng(_SEED)
        good = backup(self.mdp, swept_values(self.mdp, _GAMMA), _GAMMA).argmax(axis=1).tolist()
        over = True
        for number in range(steps):
            if over:
                with self._refusing("cannot be reset"):
                    observation = env.reset(seed=None if number else _SEED)[0]
                compare(probe.number, observation)
            state, is_random = probe.number, rng.random() < (number // 100) % 3 / 2
            action = int(rng.integers(self.mdp.num_actions)) if is_random else good[state]
            with self._refusing("cannot be stepped"):
                observation, reward, terminated, truncated, _ = env.step(action)
            self._check_step(state, action, float(_plain(reward)), bool(terminated))
            compare(probe.number, observation)
            over = terminated or truncated

    def _check_step(self, state: int, action: int, reward: float, terminated: bool) -> None:
        mdp, pair, number = self.mdp, (state, action), self._probe.number
        following = mdp.next_state[pair]
        same_end = (mdp.number[following] == number) & (mdp.terminal[following] == terminated)
        possible = same_end & (mdp.reward[pair] == reward) & (mdp.probability[pair] > 0)
        if not possible.any():
            raise InputError(
                f"{self._where}: through its wrappers, action {action} in state {state} led to state "
                f"{number} with reward {reward:g}{' and ended' if terminated else ''}, which differs from "
                "what reward() and action() returned; make them functions of their argument alone"
            )


class _Probe(gym.ObservationWrapper[Any, Any, Any]):
    """Remembers the number that the environment below all wrappers showed last."""

    number = -1

    def observation(self, observation: Any) -> Any:
        self.number = int(observation)
        return observation


def copied(real: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """A copy of an environment without wrappers, with a generator of its own, which opens no window."""
    try:
        other = copy.deepcopy(real)
    except Exception:  # a window, say; what a step sets anew is the copy's own all the same
        other = copy.copy(real)
    other.render_mode = None
    other.np_random = seeding.np_random(_SEED)[0]
    return other


def is_discrete(space: gym.Space[Any], number: int) -> bool:
    """Whether a space is that of so many actions."""
    return isinstance(space, spaces.Discrete) and space.n == number and space.start == 0


def _plain(value: Any) -> Any:
    """A number of numpy's as one of Python's."""
    return value.item() if isinstance(value, np.generic | np.ndarray) and value.size == 1 else value


def _changed(mdp: Mdp, **changes: Any) -> Mdp:
    """A world with other tables, which is not that of a map any more."""
    kept = {field.name: getattr(mdp, field.name) for field in fields(Mdp)} | changes
    tables = {key: kept[key] for key in ("next_state", "probability", "reward")}
    tables["absorbing"] = absorbing_states(**tables, terminal=mdp.terminal)
    tables["thresholds"] = thresholds_of(tables["probability"])
    return Mdp(**kept | {key: frozen(table) for key, table in tables.items()})
