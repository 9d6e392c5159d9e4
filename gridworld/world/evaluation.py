"""How good a policy is, exactly: by solving for its value.

Value and regret are without a step limit, as in the theory that the certificate rests on. What becomes of an
episode is within the step limit, as training and sampling see it. Another discount may make another policy
optimal; then no agent that learns perfectly with it can be certified.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gridworld.base.bounds import positive_int
from gridworld.base.console import telling_if_slow
from gridworld.base.errors import InputError
from gridworld.world.chain import Chain, Outcome, one_hot_policy
from gridworld.world.mdp import BY_CONSTRUCTION, FloatArray, IntArray, Mdp
from gridworld.world.proof import Bounds
from gridworld.world.solver import Solution, solved

_USUAL_DISCOUNTS = (0.8, 0.9, 0.95, 0.97, 0.99)
_QUICKLY_SOLVED = 20_000  # outcomes of all states and actions: a few tenths of a second
# Relative to the optimum's discounted absolute rewards from the start; a detour of one step costs at least
# 1 % at the default discount. Where the optimum earns and pays nothing, it is the rounding of a reward.
REGRET_TOLERANCE = 1e-6
_ROUNDING = 1e-9  # of the largest value: a smaller regret may be that of a linear system's rounding


@dataclass(frozen=True, eq=False)
class PolicySnapshot:
    """What an agent has learned about every state at one moment: all that evaluation and pictures need."""

    greedy: IntArray  # (S,), the action of the greedy policy
    sampled: FloatArray  # (S, A), float64, the action probabilities of the policy that it explores with
    values: FloatArray  # (S,), float64, its estimate of V
    q: FloatArray | None = None  # (S, A), float64, its estimate of Q; None where it has none

    def greedy_policy(self) -> FloatArray:
        """The greedy policy's action probabilities, (S, A)."""
        return one_hot_policy(self.greedy, self.sampled.shape[1])


@dataclass(frozen=True, repr=False)
class Score:
    """Exact scores of one policy, in expectation over starts."""

    value: float  # discounted, without a step limit
    regret: float  # optimal value - value, at least 0 up to rounding
    certified: bool  # no policy is better
    outcome: Outcome  # of an episode within the step limit
    scope: str = BY_CONSTRUCTION  # how the world's tables are known
    # Where it is small: it is at most this, by bounds that hold whatever rounding did. None: a certified
    # policy is so by floating point alone, as at a discount of 1.
    proven_regret: float | None = None

    @property
    def shortfall(self) -> float:
        """The regret without its rounding: 0 where no policy is better. By it policies are ranked."""
        return 0.0 if self.certified else self.regret

    def __repr__(self) -> str:
        """The numbers with four digits; a regret that is 0 but for rounding is 0."""
        numbers = {"value": self.value, "regret": self.shortfall, **vars(self.outcome)}
        shown = (f"{name}={number + 0.0:.4g}" for name, number in numbers.items())  # -0 as 0
        scope = "" if self.scope == BY_CONSTRUCTION else f", scope={self.scope!r}"
        floating = ", by floating point" if self.certified and self.proven_regret is None else ""
        return f"Score(certified={self.certified}{floating}, {', '.join(shown)}{scope})"


class Evaluator:
    """Scores policies of one world under one discount and step limit, whose optimum it solves for.

    Args:
        mdp: the world.
        gamma: the discount of value and regret.
        max_episode_steps: the step limit of an episode's outcome.

    Attributes:
        solution: the optimum under the discount.
        optimal_value: its value, in expectation over starts.
        optimum: the outcome of an episode of `optimal_policy`.
        tolerance: the regret up to which a policy is certified.

    Raises:
        InputError: no finite optimum, see `value_iteration`.
    """

    def __init__(self, mdp: Mdp, gamma: float, max_episode_steps: int) -> None:
        if not isinstance(mdp, Mdp):
            raise InputError(f"mdp={str(mdp)[:50]}: must be a compiled world, as from compile_env")
        self.mdp = mdp
        self.max_episode_steps = positive_int("max_episode_steps", max_episode_steps)
        with telling_if_slow(f"solving the world, {mdp.num_states:,} states"):
            self.solution: Solution = solved(mdp, gamma)
        self.optimal_value = self._at_start(self.solution.v)
        scale = self._at_start(self.solution.scale)
        self._earns_nothing = scale == 0
        self.tolerance = self._rounding() if self._earns_nothing else REGRET_TOLERANCE * scale
        with telling_if_slow(f"following the optimum for up to {max_episode_steps:,} steps"):
            self.optimum: Outcome = Chain(mdp, self.optimal_policy()).outcome(max_episode_steps)

    @cached_property
    def bounds(self) -> Bounds | None:
        """Proven bounds of what policies are worth; None at a discount of 1."""
        return None if self.solution.gamma == 1 else Bounds(self.mdp, self.solution, self.tolerance / 2)

    def optimal_policy(self) -> FloatArray:
        """The policy (S, A) that takes the first of the optimal actions."""
        return one_hot_policy(np.argmax(self.solution.optimal, axis=1), self.mdp.num_actions)

    def score(self, policy: FloatArray) -> Score:
        """Score a policy (S, A) of action probabilities exactly.

        Raises:
            InputError: it is no policy of this world.
        """
        chain = Chain(self.mdp, policy)
        values = self.values(chain)
        value = self._at_start(values)
        regret = 0.0 if value == self.optimal_value else self.optimal_value - value  # both may be -inf
        proven, certified = None, regret <= self.tolerance
        if certified and self.bounds is not None:
            proven = self.bounds.regret(chain.policy, values)
            certified = proven <= self.tolerance
        elif certified and not self._earns_nothing:  # nothing bounds what is lost where large rewards cancel
            lost = np.finfo(np.float64).eps * self._at_start(chain.undiscounted.scale)
            certified = max(lost, -regret) <= self.tolerance
        outcome = chain.outcome(self.max_episode_steps)
        return Score(value, regret, certified, outcome, self.mdp.scope, proven)

    def values(self, chain: Chain) -> FloatArray:
        """V_π (S,) of the policy of a chain."""
        gamma = self.solution.gamma
        # An optimum that earns nothing has no scale beside which a linear system's rounding is small.
        if self._earns_nothing:
            return chain.evaluation(gamma).value
        values = chain.value(gamma)
        regret = abs(self.optimal_value - self._at_start(values))
        is_rounding = self.tolerance < regret < _ROUNDING * np.abs(values).max(initial=0.0)
        return chain.evaluation(gamma).value if is_rounding else values

    def discounted_return(self, policy: FloatArray) -> float:
        """The exact expected discounted return of an episode within the step limit, of a policy (S, A)."""
        return Chain(self.mdp, policy).discounted_return(self.max_episode_steps, self.solution.gamma)

    def endless_states(self, policy: FloatArray) -> list[int]:
        """The states in which a policy (S, A) may loop for ever, ascending; empty if it always ends."""
        states = Chain(self.mdp, policy).endless_states()
        return [int(state) for state in states if not self.mdp.absorbing[state]]

    def _rounding(self) -> float:
        """The rounding of the largest reward that an episode can meet."""
        acting = np.flatnonzero(self.mdp.acting)
        met = np.abs(self.mdp.reward[acting])[self.mdp.probability[acting] > 0]
        return float(np.finfo(np.float64).eps * met.max(initial=0.0))

    def _at_start(self, values: FloatArray) -> float:
        starts = self.mdp.start_states
        return float(values[starts] @ self.mdp.start[starts])


def score_of_optimum(judge: Evaluator, gamma: float) -> Score:
    """The score of the optimum under another discount; of its ties, the actions that `judge` finds best."""
    mdp, best = judge.mdp, judge.solution
    own = solved(mdp, gamma)
    rank = np.where(own.optimal, np.maximum(best.q, np.finfo(np.float64).min), -np.inf)
    return judge.score(one_hot_policy(rank.argmax(axis=1), mdp.num_actions))


def fitting_discounts(judge: Evaluator) -> list[float]:
    """The usual discounts, and the judge's own, whose optimum is certified; in a large world its own only."""
    usual = _USUAL_DISCOUNTS if judge.mdp.probability.size <= _QUICKLY_SOLVED else ()
    gammas = sorted({*usual, judge.solution.gamma})
    return [gamma for gamma in gammas if score_of_optimum(judge, gamma).certified]


def as_numbers(name: str, table: Any, others: str) -> FloatArray:
    """A table as float64; refuses anything else. Messages call it `name`, and say what `others` it may be."""
    try:
        if table is None:  # which numpy takes for NaN
            raise TypeError
        return np.asarray(table, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError):  # torch's, for a tensor with a gradient
        kind = type(table).__name__
        raise InputError(f"{name}: {kind} is neither {others} nor a table of numbers") from None


def policy_of_table(mdp: Mdp, name: str, numbers: FloatArray, is_q: bool = False) -> FloatArray:
    """Actions (S,), probabilities (S, A) or Q values (S, A) as a policy (S, A); refuses anything else."""
    size = mdp.num_states
    if numbers.shape == (size,) and not is_q:
        wrong = ~np.isin(numbers, np.arange(mdp.num_actions))
        if wrong.any():
            state = int(np.argmax(wrong))
            raise InputError(
                f"{name}: state {state} has the action {numbers[state]:g}; must be {mdp.action_choices()}"
            )
        return one_hot_policy(numbers.astype(np.int64), mdp.num_actions)
    if numbers.shape != (size, mdp.num_actions):
        either = "" if is_q else f"({size},) actions or "
        raise InputError(
            f"{name}: has shape {numbers.shape}; {mdp.name} has {size} states and "
            f"{mdp.num_actions} actions, so it must be {either}({size}, {mdp.num_actions})"
        )
    if is_q:
        return one_hot_policy(numbers.argmax(axis=1), mdp.num_actions)
    if (numbers < 0).any() or (np.abs(numbers.sum(axis=1) - 1) > 1e-4).any():
        raise InputError(f"{name}: its rows are not probability distributions; give Q values as q=...")
    return numbers
