"""The probes: a row each, from one state up, and what must hold after training, by the solver's numbers.

A world is a list with, for every live state and each of its actions, the outcomes (probability, next state,
reward, whether it ends the episode). An end that leads to a live state's number looks like that state to the
agent, and does not count as a visit to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gridworld.world.chain import Chain
from gridworld.world.evaluation import Evaluator, PolicySnapshot
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp, backup, frozen
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes
from gridworld.world.solver import solved

TOLERANCE = 0.1  # of a value, relative to the largest number in the world
LEAST_BEST = 0.99  # share of late steps with a best action
PROBABILITY = 0.06  # tolerance of an action's
_VISITED = 0.05  # share of steps; an actor-critic knows the values of the states that it is in
_LIMIT = 20  # steps of an episode, unless the world says otherwise
_SMALL = 8  # states of a world whose actions are named
_LONGEST = 100  # steps that a policy is scored over
# With this bonus the soft optimum of `DEAR_CONTEXTS` is right with probability 3/4. Its advantages then have
# standard deviation 1, so that normalising them changes nothing.
PAY = 4 / math.sqrt(3)
BONUS = PAY / math.log(3)
GOES_ON, ENDS = False, True

Outcome = tuple[float, int, float, bool]


def _world(
    name: str,
    rows: Sequence[Sequence[Sequence[Outcome]]],
    start: Sequence[float] = (1.0,),
    limit: int = _LIMIT,
) -> Mdp:
    """Compile the rows; a number without a row is an end."""
    entries = [
        ((state, action, index), outcome)
        for state, row in enumerate(rows)
        for action, outcomes in enumerate(row)
        for index, outcome in enumerate(outcomes)
    ]
    size = 1 + max(len(rows) - 1, *(leads_to for _, (_, leads_to, _, _) in entries))
    shape = size, len(rows[0]), 1 + max(index for (_, _, index), _ in entries)
    probability, reward, ends = np.zeros(shape), np.zeros(shape), np.ones(shape, dtype=np.bool_)
    next_state = np.broadcast_to(np.arange(size)[:, None, None], shape).copy()
    probability[:, :, 0] = 1.0
    for place, outcome in entries:
        probability[place], next_state[place], reward[place], ends[place] = outcome
    begins = np.pad(np.asarray(start), (0, size - len(start)))
    tables = Outcomes(
        next_state=next_state, probability=probability, reward=reward, terminated=ends, start=begins
    )
    return mdp_from_outcomes(name, tables, max_episode_steps=limit)


def _sure(leads_to: int, reward: float, ends: bool) -> list[Outcome]:
    return [(1.0, leads_to, reward, ends)]


def _any(leads_to: int, reward: float, ends: bool) -> list[list[Outcome]]:
    """Whichever of two actions."""
    return [_sure(leads_to, reward, ends)] * 2


def _two_contexts(name: str, pay: float) -> Mdp:
    rows = [[_sure(2, pay * (state == action), ENDS) for action in range(2)] for state in range(2)]
    return _world(name, rows, start=(0.5, 0.5))


# Every episode is one step that pays 1.
CONSTANT = _world("constant", [_any(1, 1, ENDS)])
# Three steps, whatever the action; the last pays 1. Half of the episodes begin in state 3: action 0 pays 0.4,
# action 1 leads to the first of the three.
CORRIDOR = _world(
    "corridor",
    [
        *(_any(1, 0, GOES_ON), _any(2, 0, GOES_ON), _any(4, 1, ENDS)),
        [_sure(4, 0.4, ENDS), _sure(0, 0, GOES_ON)],
    ],
    start=(0.5, 0.0, 0.0, 0.5),
)
# One step with three actions, which pay 0, 1 and 0.5.
BANDIT = _world("bandit", [[_sure(1, pay, ENDS) for pay in (0.0, 1.0, 0.5)]])
# One step from either of two states, in each of which the other action pays 1, or 4 / √3.
TWO_CONTEXTS, DEAR_CONTEXTS = _two_contexts("two contexts", 1.0), _two_contexts("dear contexts", PAY)
# The first action decides whether the fourth step pays 1; those between have no effect.
_BETWEEN = [_any(state + 2, 0, GOES_ON) for state in (1, 2, 3, 4)]
_FIRST = [_sure(1, 0, GOES_ON), _sure(2, 0, GOES_ON)]
DELAY = _world("delay", [_FIRST, *_BETWEEN, _any(7, 1, ENDS), _any(7, 0, ENDS)])
# Action 0 pays 0.7 and ends, action 1 leads to where 1 is paid; both ends look like the start.
END_LIKE_THE_START = _world(
    "end like the start", [[_sure(0, 0.7, ENDS), _sure(1, 0, GOES_ON)], _any(0, 1, ENDS)]
)
# One state that pays 1 a step; only a step limit of 5 ends an episode.
ENDLESS = _world("endless", [_any(0, 1, GOES_ON)], limit=5)
# Action 0 pays 1.1 and ends, action 1 leads to an endless 1 a step, of which a step limit leaves one.
CUT_SHORT = _world("cut short", [[_sure(2, 1.1, ENDS), _sure(1, 0, GOES_ON)], _any(1, 1, GOES_ON)], limit=2)
# One step: action 0 pays 0.1, action 1 pays 1 with probability 0.4.
GAMBLE = _world("gamble", [[_sure(1, 0.1, ENDS), [(0.4, 1, 1.0, ENDS), (0.6, 1, 0.0, ENDS)]]])
# Two states; action 1 goes to the other one, which pays 1 on the way from state 1 to state 0.
ALTERNATION = _world(
    "alternation",
    [[_sure(0, 0, GOES_ON), _sure(1, 0, GOES_ON)], [_sure(1, 0, GOES_ON), _sure(0, 1, GOES_ON)]],
    limit=10,
)
# Action 0 pays 0.2 and ends; action 1 costs 0.2 and leads to where action 1 pays 1.
TRAP = _world(
    "trap", [[_sure(2, 0.2, ENDS), _sure(1, -0.2, GOES_ON)], [_sure(2, 0, ENDS), _sure(2, 1, ENDS)]]
)
# Three cells; action 1 moves on with probability 0.8, else it stays; the last cell pays 1.
SLIPPERY = _world(
    "slippery",
    [
        [_sure(0, 0, GOES_ON), [(0.8, 1, 0.0, GOES_ON), (0.2, 0, 0.0, GOES_ON)]],
        [_sure(0, 0, GOES_ON), [(0.8, 2, 1.0, ENDS), (0.2, 1, 0.0, GOES_ON)]],
    ],
)
# Four parts, each with a start. From state 0, action 0 takes the longer way, three steps that cost 1 each,
# action 1 the shorter one, which costs 2.3. From state 3, action 0 costs 0.5 and ends, action 1 leads to
# where action 0 costs 2 and action 1 nothing. From state 5, action 0 pays 3, action 1 leads to where 5 is
# paid. From state 7, action 0 costs 5 and leads to where 1 is paid, action 1 costs 3 and ends.
COSTS_AND_LARGE = _world(
    "costs and large rewards",
    [
        *([_sure(1, -1, GOES_ON), _sure(9, -2.3, ENDS)], _any(2, -1, GOES_ON), _any(9, -1, ENDS)),
        *([_sure(9, -0.5, ENDS), _sure(4, 0, GOES_ON)], [_sure(9, -2, ENDS), _sure(9, 0, ENDS)]),
        *([_sure(9, 3, ENDS), _sure(6, 0, GOES_ON)], _any(9, 5, ENDS)),
        *([_sure(8, -5, GOES_ON), _sure(9, -3, ENDS)], _any(9, 1, ENDS)),
    ],
    start=(0.5, 0.0, 0.0, 0.25, 0.0, 0.125, 0.0, 0.125),
)


@dataclass(frozen=True, eq=False)
class Trained:
    """An implementation after training."""

    mdp: Mdp
    gamma: float
    first: PolicySnapshot  # what it had before training
    last: PolicySnapshot  # what it has learned
    greedy: FloatArray  # (S, A), its own deterministic policy
    visits: IntArray  # (S, A), its actions in training
    late: IntArray  # (S, A), those in the last two fifths of it
    frozen: list[str]  # the names of the parameters that training left as they were
    unknown: Mapping[str, str] = field(default_factory=dict)  # what it does not show, and why

    def ask(self, what: str) -> None:
        """UnknownError: it does not show its `values`, `probabilities`, `behaviour` or `parameters`."""
        if what in self.unknown:
            raise UnknownError(self.unknown[what])


class UnmetError(Exception):
    """An expectation that does not hold; says what was found instead."""


class UnknownError(Exception):
    """An expectation that is about something that the implementation does not show."""


def values(trained: Trained) -> str:
    """Its values are the exact ones: Q* of a learner of Q, of an actor-critic V of its own policy."""
    trained.ask("values")
    mdp, last = trained.mdp, trained.last
    if last.q is not None:
        return _near(mdp, last.q, solved(mdp, trained.gamma).q)
    often = trained.late.sum(axis=1) >= _VISITED * trained.late.sum()
    return _near(mdp, last.values, Chain(mdp, last.sampled).value(trained.gamma), often)


def optimal(trained: Trained) -> str:
    """Its deterministic policy is optimal from the start, exactly."""
    mdp = trained.mdp
    score = Evaluator(mdp, trained.gamma, mdp.max_episode_steps or _LONGEST).score(trained.greedy)
    if not score.certified:
        actions = trained.greedy.argmax(axis=1)[mdp.reachable & ~mdp.terminal].tolist()
        best = f"its best actions are {actions}, with" if len(actions) <= _SMALL else "its best actions have"
        raise UnmetError(f"{best} regret {score.regret:.3g}")
    return "optimal"


def optimal_with_values(trained: Trained) -> str:
    """Both, if it shows its values."""
    return optimal(trained) if "values" in trained.unknown else f"{optimal(trained)}, {values(trained)}"


def values_if_optimal(trained: Trained) -> str:
    """Its values, which are of another policy where its own is not optimal."""
    try:
        optimal(trained)
    except UnmetError:
        raise UnknownError("not asked, its policy is not optimal") from None
    return values(trained)


def acts_as_learned(trained: Trained) -> str:
    """At the end of training nearly all its actions are optimal."""
    trained.ask("behaviour")
    best = solved(trained.mdp, trained.gamma).optimal
    steps = int(trained.late.sum())
    if steps == 0:
        raise UnknownError("takes no steps at the end")
    share = float(trained.late[best].sum()) / steps
    if share < LEAST_BEST:
        raise UnmetError(f"{share:.0%} of its last actions are optimal, must be {LEAST_BEST:.0%}")
    return f"{share:.0%} of its last actions are best ones"


def acts_at_random(trained: Trained) -> str:
    """In training, all actions of a state are as frequent as each other."""
    shares = trained.visits / np.maximum(trained.visits.sum(axis=1, keepdims=True), 1)
    uniform = np.full(shares.shape, 1 / trained.mdp.num_actions)
    return _near(trained.mdp, shares, uniform, probability=True)


def soft_optimal(trained: Trained) -> str:
    """Its policy is the best one for the reward of its one step and `BONUS` times its entropy."""
    trained.ask("probabilities")
    gains = np.exp(solved(trained.mdp, trained.gamma).q / BONUS)
    aim = gains / gains.sum(axis=1, keepdims=True)
    return _near(trained.mdp, trained.last.sampled, aim, probability=True)


def all_layers_learn(trained: Trained) -> str:
    """Training has changed every parameter."""
    trained.ask("parameters")
    if trained.frozen:
        raise UnmetError(f"{', '.join(trained.frozen)} did not change")
    return "all have changed"


def first_backup(trained: Trained) -> str:
    """Its Q values are one backup of what it had before training."""
    mdp = trained.mdp
    trained.ask("parameters")
    assert trained.first.q is not None
    assert trained.last.q is not None
    exact = backup(mdp, np.where(mdp.terminal, 0.0, trained.first.q.max(axis=1)), trained.gamma)
    return _near(mdp, trained.last.q, exact)


def _near(
    mdp: Mdp, found: FloatArray, exact: FloatArray, states: BoolArray | None = None, probability: bool = False
) -> str:
    """Compare numbers of live states, or of these (S,) of them; says which is farthest from the exact one."""
    where = mdp.reachable & ~mdp.terminal & (True if states is None else states)
    where = np.broadcast_to(where.reshape(-1, *[1] * (exact.ndim - 1)), exact.shape)
    largest = max(np.abs(exact[where]).max(initial=0), np.abs(mdp.reward[mdp.reachable]).max())
    tolerance = PROBABILITY if probability else TOLERANCE * largest
    error = np.where(where, np.abs(found - exact), -1.0)
    worst = tuple(int(each) for each in np.unravel_index(np.argmax(error), error.shape))
    name = "P" if probability else "Q" if len(worst) == 2 else "V"
    text = f"{name}({', '.join(map(str, worst))}) {found[worst]:z.3f}, exact {exact[worst]:z.3f}"
    if not error[worst] <= tolerance:
        raise UnmetError(f"{text}, tolerance {tolerance:.2g}")
    return text


@dataclass(frozen=True)
class Probe:
    """One question about an implementation."""

    name: str  # as the command line has it
    world: Mdp  # that it trains on
    holds: Callable[[Trained], str]  # after training; raises `UnmetError`, else says what was found
    meaning: str  # what a failure means
    gamma: float = 0.9  # that it trains with
    arguments: Mapping[str, Any] = field(default_factory=dict)  # that differ from `settings`
    needs: str = ""  # an argument; an algorithm that does not take it is not asked
    starts: Sequence[int] = ()  # of its world, from which it asks; (): all
    follows: Sequence[str] = ()  # earlier probes whose failure may be the cause of a failure

    @property
    def training(self) -> tuple[str, float, str]:
        """Probes with the same one share a training run."""
        return self.world.digest(), self.gamma, repr(self.arguments)

    def asked(self, trained: Trained) -> Trained:
        """The same, where its world begins in the states that the probe asks from."""
        mdp = trained.mdp
        if not self.starts:
            return trained
        start = np.zeros(mdp.num_states)
        start[list(self.starts)] = 1 / len(self.starts)
        return replace(trained, mdp=replace(mdp, start=frozen(start)))

    def found(self, trained: Trained) -> str:
        """What was found where it holds; raises `UnmetError`, or `UnknownError`."""
        return self.holds(self.asked(trained))


_NO_EXPLORATION_LEFT = {"exploration_final_eps": 0.0}
_ONE_STEP = ("constant", "choice", "context")  # what all others rest on
_BASIC = (*_ONE_STEP, "termination", "discount")  # what worlds of several steps rest on

# fmt: off
PROBES = (
    Probe("constant", CONSTANT, values,
          "values are not learned at all: check the loss, the optimiser and the reward that reaches it; too "
          "large, they are bootstrapped past the end of an episode, or the policy's loss moves them too (its "
          "advantage must be detached)"),
    Probe("choice", BANDIT, optimal,
          "worse actions are preferred: the advantage's sign is wrong, or rewards go to the wrong actions"),
    Probe("context", TWO_CONTEXTS, optimal,
          "the policy does not depend on the state: observations are lost, mixed up or from another step",
          arguments=_NO_EXPLORATION_LEFT, follows=("choice",)),
    Probe("behaviour", TWO_CONTEXTS, acts_as_learned,
          "it does not act as it has learned: exploration ends late or never, or acting and learning see "
          "different observations",
          arguments=_NO_EXPLORATION_LEFT, follows=("choice", "context")),
    Probe("layers", TWO_CONTEXTS, all_layers_learn,
          "a layer never changes: the optimiser lacks it, it gets no gradient or it is never copied",
          arguments=_NO_EXPLORATION_LEFT),
    Probe("exploration", TWO_CONTEXTS, acts_at_random,
          "it explores less than its epsilon says: epsilon is ignored, scaled or starts elsewhere",
          arguments={"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0},
          needs="exploration_final_eps"),
    Probe("termination", END_LIKE_THE_START, optimal_with_values,
          "values are bootstrapped past the end of an episode: the terminal flag is ignored",
          gamma=0.95, follows=_ONE_STEP),
    Probe("entropy", DEAR_CONTEXTS, soft_optimal,
          "the entropy bonus does not match its coefficient (wrong sign or scale, missing, or not of each "
          "state's policy), or advantages leak from one episode into another",
          arguments={"ent_coef": BONUS}, needs="ent_coef", follows=(*_ONE_STEP, "termination")),
    Probe("discount", CORRIDOR, optimal_with_values,
          "gamma is ignored or applied at the wrong step, or a reward is credited to another step",
          gamma=0.5, needs="gamma", follows=(*_ONE_STEP, "termination")),
    Probe("truncation", CUT_SHORT, optimal,
          "a step limit is treated as termination: the value of the last state is missing, or hidden by what "
          "leaks from the next episode",
          gamma=0.8, follows=(*_ONE_STEP, "termination")),
    Probe("leak", CUT_SHORT, values_if_optimal,
          "values or advantages leak from one episode into another: after a step limit, the next episode's "
          "count as if it continued this one",
          gamma=0.8, follows=("constant", "termination", "discount")),
    Probe("delay", DELAY, optimal_with_values,
          "credit does not reach earlier steps: returns, traces or next observations are off by a step",
          follows=(*_ONE_STEP, "discount")),
    Probe("stochastic", GAMBLE, optimal_with_values,
          "it does not learn the mean of a random reward, but an extreme, its median or its last draw",
          follows=("constant", "choice", "termination")),
    Probe("alternation", ALTERNATION, optimal_with_values,
          "the value of the next state is wrong: another state's, or not that of its best action",
          gamma=0.8, follows=(*_BASIC, "truncation", "leak", "delay")),
    Probe("trap", TRAP, optimal_with_values,
          "the next reward counts for more than the return: later rewards are not added, costs are lost, or "
          "the value of the next state is not that of its best action",
          follows=(*_BASIC, "delay")),
    Probe("costs", COSTS_AND_LARGE, optimal_with_values,
          "values below 0 are lost (the largest is searched from 0 or -1, or by size without its sign, the "
          "output is never negative, or targets are cut off at 0), or rewards are shifted",
          starts=(0, 3), follows=(*_BASIC, "delay", "trap")),
    Probe("large", COSTS_AND_LARGE, optimal_with_values,
          "rewards or targets beyond 1 are changed: clipped, replaced by their sign, normalised or shifted",
          starts=(5, 7), follows=(*_BASIC, "delay", "trap", "costs")),
    Probe("slip", SLIPPERY, optimal_with_values,
          "random transitions are not averaged over, or next states are wrong",
          follows=(*_BASIC, "delay", "stochastic", "alternation")),
    Probe("target", ENDLESS, first_backup,
          "targets are not computed with the target network: it is never updated, or lags behind",
          gamma=0.8, arguments={"target_update_interval": 10_000_000}, needs="target_update_interval",
          follows=("constant", "discount", "truncation")),
)
# fmt: on
