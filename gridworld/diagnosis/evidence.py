"""What is known of a finished run, where its regret comes from, and experiments on its tables.

The performance-difference lemma says

    V*(start) - V_π(start) = Σ_s d_π(s) [ V*(s) - Σ_a π(a|s) Q*(s, a) ],    d_π(s) = Σ_t γ^t P(s_t = s),

a sum over states of the discounted visits under π times what its action there loses.
With γ = 1 a policy that never ends has no such sum. The walk then stops where it cannot end any more, and
such a state costs its visits times V* - V_π, all that is lost from there on.

As `world.evaluation` has it, value and regret are without a step limit. What an episode of training
loses by being cut off is therefore no part of the split.

Reference: S. Kakade and J. Langford, Approximately optimal approximate reinforcement learning, ICML 2002.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import Agent
from gridworld.base.bounds import LINEAR, falls, parse_schedule
from gridworld.base.errors import InputError
from gridworld.config.train import TrainConfig
from gridworld.run.reader import read_columns
from gridworld.training.saved_run import SavedRun, read_visits
from gridworld.world.chain import Chain, discounted_visits, stopping_states
from gridworld.world.evaluation import Evaluator, PolicySnapshot, Score
from gridworld.world.mdp import BoolArray, FloatArray, Mdp, backup
from gridworld.world.solver import Solution, pick, solved

_ENOUGH = {False: 3000, True: 500}  # updates, by whether it is an actor-critic
_MEETINGS = 10  # of a random walk with the goal
_FAR = 10  # times the learning rate
_MOST = 100  # times as long
_SWEEPS = 1000
_ROUNDS = 60


@dataclass(frozen=True, eq=False)
class RegretSplit:
    """The regret of one policy by state."""

    score: Score  # of the policy
    visits: FloatArray  # (S,), discounted, from the start on; where a walk that cannot end stops, its chance
    lost: FloatArray  # (S,), what one visit costs
    cost: FloatArray  # (S,), their product; sums to the regret
    wrong: BoolArray  # (S,), reached, and its action is not among the optimal ones


def split_regret(evaluator: Evaluator, policy: FloatArray) -> RegretSplit:
    """Split the regret of a policy (S, A) over the states where it errs."""
    mdp, best = evaluator.mdp, evaluator.solution
    chain = Chain(mdp, policy)
    stops = stopping_states(chain, best.gamma)
    visits = discounted_visits(chain, best.gamma, stops)
    with np.errstate(invalid="ignore"):  # where V* is -inf, every action is as good
        chosen = np.where(chain.policy > 0, chain.policy * best.q, 0.0).sum(axis=1)
        lost = best.v - chosen
        lost[stops] = (best.v - chain.value(best.gamma))[stops]
        cost = np.where(visits > 0, visits * lost, 0.0)
    lost, cost = (np.where(np.isnan(each), 0.0, each) for each in (lost, cost))
    errs = ((chain.policy > 0) & ~best.optimal).any(axis=1) & ~mdp.absorbing
    return RegretSplit(evaluator.score(policy), visits, lost, cost, (visits > 0) & errs)


@dataclass(eq=False)
class Evidence:
    """A run, as its files and its agent have it; what takes time to compute is computed when asked for."""

    config: TrainConfig
    overrides: Sequence[str] | None  # the words of its command line; None: not all can be given again
    curve: Mapping[str, NDArray[Any]]  # (evaluations,) each, the columns of `curve.csv`
    visits: NDArray[np.int64]  # (S, A), how often training took each action in each state
    evaluator: Evaluator  # of its world
    agent: Agent
    snapshot: PolicySnapshot  # what the agent holds of every state

    @classmethod
    def of(cls, saved: SavedRun) -> Evidence:
        """Read a run's files."""
        agent, visits = saved.agent(), read_visits(saved.run, saved.mdp.next_state.shape[:2])
        curve, evaluator = read_columns(saved.run), saved.evaluator()
        words = None if saved.omission else saved.overrides
        return cls(saved.config, words, curve, visits, evaluator, agent, agent.snapshot())

    def __post_init__(self) -> None:
        self.mdp, snapshot = self.evaluator.mdp, self.snapshot
        self.greedy = snapshot.greedy  # (S,)
        self.values = np.where(self.mdp.terminal, 0.0, snapshot.values)  # (S,)
        self.spread = entropy(snapshot.sampled)  # (S,)
        self.gamma = float(getattr(self.config.agent, "gamma", self.evaluator.solution.gamma))  # the agent's
        self.largest_reward = float(np.abs(self.mdp.reward).max())  # of a step
        self.is_tabular = self.config.agent.family == "tabular"
        self.is_actor_critic = snapshot.q is None  # it has a policy of its own and no Q
        # At which small networks learn with Adam, or the table of a deterministic world.
        self.usual_rate = 0.5 if self.is_tabular else 0.005 if self.is_actor_critic else 0.001

    @cached_property
    def split(self) -> RegretSplit:
        """The regret of the greedy policy."""
        return split_regret(self.evaluator, self.snapshot.greedy_policy())

    @cached_property
    def own(self) -> Solution:
        """The optimum under the agent's own discount, or the evaluation's where that has none."""
        try:
            return solved(self.mdp, self.gamma)
        except InputError:
            return self.evaluator.solution

    @cached_property
    def q(self) -> FloatArray:
        """(S, A), the agent's Q; of an agent without, one backup of its values."""
        return backup(self.mdp, self.values, self.gamma) if self.snapshot.q is None else self.snapshot.q

    @cached_property
    def gap(self) -> FloatArray:
        """(S,), what the greedy action loses under the agent's own discount."""
        return np.asarray(self.own.v - pick(self.own.q, self.greedy))

    @cached_property
    def steps_to_goal(self) -> float:
        """The exact expected number of steps until a random walk first meets a goal, by Wald's identity."""
        uniform = np.full_like(self.snapshot.sampled, 1 / self.mdp.num_actions)
        walk = Chain(self.mdp, uniform).outcome(self.evaluator.max_episode_steps)
        return walk.expected_length / walk.goal if walk.goal > 0 else np.inf

    def setting(self, name: str, default: float = 0.0) -> float:
        """A number among the agent's settings or its model's defaults; of a schedule the first value."""
        given = self._given(name)
        if given is None and not self.is_tabular:
            given = getattr(self.agent.model, name, None)
        if isinstance(given, str):
            return parse_schedule(name, given).initial
        given = getattr(given, "frequency", given)  # of SB3's TrainFreq
        if isinstance(given, list | tuple):
            given = given[0]
        return float(given) if isinstance(given, int | float) else default

    def last_setting(self, name: str) -> float:
        """The same, but of a schedule its last value."""
        return 0.0 if self.falls(name) else self.setting(name)

    def falls(self, name: str) -> bool:
        """Whether one of the agent's settings is a schedule, which ends at 0."""
        return falls(self._given(name))

    def takes(self, name: str) -> bool:
        """Whether the agent has a setting of this name."""
        return hasattr(self.config.agent, name) or name in signature(type(self.agent.model)).parameters

    def change(self, name: str, value: float | str) -> str:
        """The word that sets one of the agent's settings on a command line."""
        text = value if isinstance(value, str) else f"{value:.3g}" if value % 1 else f"{value:.0f}"
        return f"{self.config.agent.key(name)}={text}"

    def multiplied(self, name: str, by: float, most: float = math.inf) -> str:
        """The word that multiplies one of the agent's settings, of which a schedule stays one."""
        given, value = self._given(name), min(by * self.setting(name), most)
        return self.change(name, f"{given.partition('_')[0]}_{value:.3g}" if falls(given) else value)

    def _given(self, name: str) -> Any:
        given = getattr(self.config.agent, name, None)
        return getattr(self.config.agent, "arguments", {}).get(name) if given is None else given

    @property
    def rollout(self) -> int:
        """The environment steps from one update to the next."""
        return int(self.setting("train_freq") or self.setting("n_steps", 1)) * self.config.n_envs

    @property
    def steps(self) -> int:
        """The environment steps of training, which ends with a whole rollout."""
        return math.ceil(self.config.total_timesteps / self.rollout) * self.rollout

    @cached_property
    def updates(self) -> float:
        """How many gradient steps training made, as its settings say."""
        total, rollout = self.steps, self.rollout
        if epochs := self.setting("n_epochs"):
            return total / rollout * epochs * math.ceil(rollout / self.setting("batch_size", 64))
        if not self.setting("train_freq"):
            return total / rollout
        steps = self.setting("gradient_steps", 1)
        learns = max(0.0, total - self.setting("learning_starts"))
        return learns / rollout * (rollout if steps < 0 else steps)


def entropy(policy: FloatArray) -> FloatArray:
    """(S,), the entropy of a policy (S, A), 1 where it is uniform."""
    logs = np.log(np.maximum(policy, 1e-300))
    return np.asarray(np.abs((policy * logs).sum(axis=1)) / max(np.log(policy.shape[1]), 1e-300))


def percent(share: float) -> str:
    """Write 0.0138 as 1.4%."""
    return f"{100 * share:.2g}%" if share < 0.995 else "100%"


@dataclass(frozen=True, eq=False)
class Finding:
    """One cause, as a run shows it."""

    cause: str  # its name
    states: BoolArray  # (S,), where it explains an error
    why: str  # what was found, the end of a sentence
    changes: tuple[str, ...]  # words for a command line, the best first


Cause = Callable[[Evidence], Finding | None]  # None: it is not this run's


def costliest(run: Evidence, states: BoolArray) -> int:
    """The state of these (S,) whose error costs most."""
    return int(np.argmax(np.where(states, run.split.cost, -np.inf)))


def slower(run: Evidence) -> tuple[str, ...]:
    """Words for smaller learning rates: of a network, first the usual one where its own is above it."""
    first = min(0.1, run.usual_rate / max(run.setting("learning_rate"), 1e-300))
    return tuple(run.multiplied("learning_rate", by) for by in (first, first / 10))


def falling(run: Evidence) -> tuple[str, ...]:
    """The word for a learning rate that falls to 0; none where it does."""
    if run.falls("learning_rate"):
        return ()
    rate = run.setting("learning_rate")
    rate = rate if run.is_tabular else min(rate, run.usual_rate)
    return (run.change("learning_rate", f"{LINEAR}{rate:g}"),)


def faster(run: Evidence) -> tuple[str, ...]:
    """Words for a network that learns too slowly: what scales its steps, the usual rate, and a longer run."""
    optimizer = getattr(getattr(run.agent.model, "policy", None), "optimizer", None)
    is_plain = "SGD" in type(optimizer).__name__
    adam = (run.change("policy_kwargs.optimizer_class", "torch.optim.Adam"),) if is_plain else ()
    by = run.usual_rate / max(run.setting("learning_rate"), 1e-300)
    return *adam, *((run.multiplied("learning_rate", by),) if by > 2 else ()), longer(run, 4)


def longer(run: Evidence, times: int, keep_rate: bool = False) -> str:
    """The words for a run so many times as long or more; a small rate changes too, unless `keep_rate`."""
    total = run.config.total_timesteps
    updates = 1.0 if run.is_tabular else _ENOUGH[run.is_actor_critic] / max(run.updates, 1.0)
    goals = _MEETINGS * run.steps_to_goal / total if np.isfinite(run.steps_to_goal) else 1.0
    word = f"total_timesteps={total * max(times, math.ceil(min(max(updates, goals), _MOST)))}"
    by = run.usual_rate / max(run.setting("learning_rate", 1.0), 1e-300)
    return f"{word} {run.multiplied('learning_rate', by)}" if by > _FAR and not keep_rate else word


def best_of_what_was_tried(evaluator: Evaluator, tried: BoolArray) -> FloatArray:
    """(S,), the value of the best policy that takes tried actions (S, A) only; V* where nothing was tried."""
    mdp, best = evaluator.mdp, evaluator.solution
    known = tried.any(axis=1) & ~mdp.absorbing
    least = np.where(np.isfinite(best.v), -best.scale.max(), best.v)
    v: FloatArray = np.where(known, least, best.v)
    for _ in range(_SWEEPS):
        q = np.where(tried[known], backup(mdp, v, best.gamma, np.flatnonzero(known)), -np.inf)
        new = q.max(axis=1, initial=-np.inf)
        change = np.abs(new - v[known]).max(initial=0.0)
        v[known] = new
        if not change > 1e-9 * best.scale.max():
            break
    return v


@lru_cache(maxsize=1)  # two causes ask
def entropy_optimum(run: Evidence, bonus: float) -> FloatArray:
    """The policy (S, A) that an entropy bonus aims at: π = softmax(A_π / bonus), found by iteration.

    Where advantages are normalised, as PPO does, they are divided by their deviation under π first.
    """
    mdp, normalised = run.mdp, bool(getattr(run.agent.model, "normalize_advantage", False))
    policy = np.full_like(run.snapshot.sampled, 1 / mdp.num_actions)
    for _ in range(_ROUNDS):
        v = Chain(mdp, policy).value(min(run.gamma, 0.9999))
        advantage = backup(mdp, v, run.gamma) - v[:, None]
        weight = run.mdp.acting[:, None] * policy
        deviation = np.sqrt((weight * advantage**2).sum() / weight.sum()) if normalised else 1.0
        logits = advantage / max(bonus * deviation, 1e-12)
        aimed = np.exp(np.minimum(logits - logits.max(axis=1, keepdims=True), 0.0))
        policy = 0.5 * policy + 0.5 * aimed / aimed.sum(axis=1, keepdims=True)
    return policy


def optimum_of_epsilon(mdp: Mdp, gamma: float, epsilon: float) -> FloatArray:
    """Q (S, A) of the best policy whose actions are replaced by random ones with probability epsilon."""
    v = np.zeros(mdp.num_states)
    for _ in range(_SWEEPS):
        q = backup(mdp, v, gamma)
        new = ((1 - epsilon) * q.max(axis=1) + epsilon * q.mean(axis=1)) * ~mdp.absorbing
        change, v = np.abs(new - v).max(), new
        if change <= 1e-12:
            break
    return backup(mdp, v, gamma)


def visits_needed(run: Evidence) -> float:
    """How often an action must be tried to tell the closest actions apart; 0: nothing is left to chance.

    A rate that falls linearly to 0 over n tries averages about the last √n targets. Three standard deviations
    of that mean are to be below the smallest gap on the optimal policy's way.
    """
    mdp, own = run.mdp, run.own
    targets = mdp.reward + own.gamma * np.where(mdp.terminal, 0.0, own.v)[mdp.next_state]
    mean = (mdp.probability * targets).sum(axis=2, keepdims=True)
    variance = (mdp.probability * (targets - mean) ** 2).sum(axis=2)
    gap = own.v - np.where(own.optimal, -np.inf, own.q).max(axis=1)
    way = on_the_way(run)
    return float(9 * variance[way].max() / max(gap[way].min(), 1e-6) ** 2) ** 2


def on_the_way(run: Evidence) -> BoolArray:
    """(S,), where the optimal policy acts."""
    chain = Chain(run.mdp, run.evaluator.optimal_policy())
    gamma = run.evaluator.solution.gamma
    return (discounted_visits(chain, gamma, stopping_states(chain, gamma)) > 0) & run.mdp.acting
