"""How Lab 1 is marked: by the exact solver, on the sheet's world or on those in `hidden/`."""

from collections.abc import Iterator

import numpy as np
from grading import Work, WrongAnswerError, exercise, numbers

from gridworld import Evaluator, Mdp, compile_mdp
from gridworld.world.chain import Chain
from gridworld.world.layout import parse
from gridworld.world.mdp import backup
from gridworld.world.solver import solved

PUBLIC = {  # a name, a map, a slip and a discount
    "worlds": [["the sheet's world", "S.....\n....T.\n...TG.\n....T.\n......\n", 0.2, 0.95]]
}
TOLERANCE = 1e-6


def worlds() -> Iterator[tuple[str, Mdp, float]]:
    """Worlds with a description and a discount."""
    for name, text, slip, gamma in PUBLIC["worlds"]:
        for step_reward in (0.0, -0.1):
            mdp = compile_mdp(parse(text, name), slip=slip, step_reward=step_reward)
            yield f"{name} (slip {slip:g}, step reward {step_reward:g}, gamma {gamma:g})", mdp, gamma


def count() -> int:
    return len(list(worlds()))


def policies(mdp: Mdp) -> np.ndarray:
    """A random policy (S, A)."""
    return np.random.default_rng(0).dirichlet(np.ones(mdp.num_actions), mdp.num_states)


def compare(function: str, found: np.ndarray, exact: np.ndarray, where: str, tolerance: float) -> None:
    error = np.abs(found - exact)
    if not error.max() <= tolerance:
        state = int(np.unravel_index(error.argmax(), error.shape)[0])
        raise WrongAnswerError(f"`{function}` is wrong by {error.max():.2g} in state {state} of {where}")


@exercise("1.1 by hand", points=2)
def by_hand(work: Work) -> str:
    mdp = compile_mdp(parse("S..G\n", "the corridor"))
    for name, probabilities in (("VALUES_RIGHT", [0, 1, 0, 0]), ("VALUES_COIN", [0, 0.5, 0, 0.5])):
        exact = Chain(mdp, np.tile(np.array(probabilities, dtype=float), (4, 1))).value(0.9)[:3]
        found = numbers(f"`{name}`", work.value(name), (3,))
        wrong = np.flatnonzero(np.abs(found - exact) > 1e-5)
        if wrong.size:
            state, given = wrong[0], found[wrong[0]]
            raise WrongAnswerError(f"`{name}`: the value of state {state} is not {given:.6g} to within 1e-5")
    return "all six values are right"


@exercise("1.2 backup", points=2)
def one_backup(work: Work) -> str:
    for where, mdp, gamma in worlds():
        v = np.random.default_rng(1).normal(size=mdp.num_states) * ~mdp.terminal
        found = work.array("backup", mdp, v, gamma, shape=mdp.next_state.shape[:2])
        compare("backup", found, backup(mdp, v, gamma), where, 1e-9)
    return f"right in {count()} worlds"


@exercise("1.3 values of a policy", points=3)
def values_of_a_policy(work: Work) -> str:
    for where, mdp, gamma in worlds():
        policy = policies(mdp)
        found = work.array("policy_values", mdp, policy, gamma, shape=(mdp.num_states,))
        compare("policy_values", found, Chain(mdp, policy).value(gamma), where, TOLERANCE)
    return f"right in {count()} worlds, for random policies"


@exercise("1.4 value iteration", points=3)
def optimal_values(work: Work) -> str:
    for accuracy in (1e-6, 1e-3):
        for where, mdp, gamma in worlds():
            found = work.array("value_iteration", mdp, gamma, accuracy, shape=(mdp.num_states,))
            asked = f"{where}, where {accuracy:g} was asked for"
            compare("value_iteration", found, solved(mdp, gamma).v, asked, accuracy)
    return f"as accurate as asked for in {count()} worlds"


@exercise("1.5 all optimal actions", points=3)
def all_optimal_actions(work: Work) -> str:
    for where, mdp, gamma in worlds():
        exact = solved(mdp, gamma)
        found = work.array("optimal_actions", mdp, exact.v, gamma, shape=exact.optimal.shape)
        wrong = np.flatnonzero(((found != exact.optimal) & mdp.acting[:, None]).any(axis=1))
        if wrong.size:
            raise WrongAnswerError(f"`optimal_actions` differs in {mdp.state_name(int(wrong[0]))} of {where}")
    return f"right in {count()} worlds, with all ties"


@exercise("1.6 policy iteration", points=3)
def optimal_policy(work: Work) -> str:
    for where, mdp, gamma in worlds():
        found = work.array("policy_iteration", mdp, gamma, shape=(mdp.num_states,))
        if not np.isin(found, range(mdp.num_actions)).all():
            raise WrongAnswerError(f"`policy_iteration` must return actions from 0 to {mdp.num_actions - 1}")
        score = Evaluator(mdp, gamma, 100).score(np.eye(mdp.num_actions)[found.astype(int)])
        if not score.certified:
            raise WrongAnswerError(f"`policy_iteration` has a regret of {score.regret:.2g} in {where}")
    return f"certified optimal in {count()} worlds"
