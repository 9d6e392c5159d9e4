"""What is known of a finished run, and where its regret comes from: the exact share of each state.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import Agent, PolicySnapshot
from gridworld.config.fields import falls, parse_schedule
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.report.evidence import read_columns
from gridworld.restore.saved_run import SavedRun, read_visits
from gridworld.world.chain import Chain, discounted_visits, stopping_states
from gridworld.world.evaluation import Evaluator, Score
from gridworld.world.mdp import BoolArray, FloatArray
from gridworld.world.solver import Solution, backup, pick, solved


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
    overrides: Sequence[str]  # the words of its command line
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
        return cls(saved.config, saved.overrides, curve, visits, evaluator, agent, agent.snapshot())

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
        """The exact expected number of steps until a random walk first meets a goal.

        By Wald's identity the expected length of an episode by its probability of a goal, time-outs included.
        """
        uniform = np.full_like(self.snapshot.sampled, 1 / self.mdp.num_actions)
        walk = Chain(self.mdp, uniform).outcome(self.evaluator.max_episode_steps)
        return walk.expected_length / walk.goal if walk.goal > 0 else np.inf

    def setting(self, name: str, default: float = 0.0) -> float:
        """A number among the agent's settings: as configured, or as its model has it by default.

        Of a schedule it is the first value; the default stands in for what the agent has not.
        """
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

    @cached_property
    def updates(self) -> float:
        """How many gradient steps training made, as its settings say."""
        total, envs = self.config.total_timesteps, self.config.n_envs
        if epochs := self.setting("n_epochs"):
            rollout = self.setting("n_steps", 1) * envs
            return total / rollout * epochs * math.ceil(rollout / self.setting("batch_size", 64))
        if not self.setting("train_freq"):
            return total / (self.setting("n_steps", 1) * envs)
        rollout = self.setting("train_freq", 1) * envs
        steps = self.setting("gradient_steps", 1)
        learns = max(0.0, total - self.setting("learning_starts"))
        return learns / rollout * (rollout if steps < 0 else steps)


def entropy(policy: FloatArray) -> FloatArray:
    """(S,), the entropy of a policy (S, A), 1 where it is uniform."""
    logs = np.log(np.maximum(policy, 1e-300))
    return np.asarray(np.abs((policy * logs).sum(axis=1)) / max(np.log(policy.shape[1]), 1e-300))
