"""How Lab 3 is marked: formulas by exact values, causes by `diagnose`, the remedy by the certificate."""

from collections.abc import Iterator
from functools import cache

import numpy as np
from grading import Work, WrongAnswerError, exercise

import gridworld
from gridworld import Evaluator, InputError, Mdp, compile_mdp
from gridworld.world.chain import Chain
from gridworld.world.layout import parse
from gridworld.world.mdp import backup
from gridworld.world.solver import solved

PUBLIC = {  # a name, a map, a slip and a reward of each step; `hidden/` has others
    "worlds": [["the sheet's world", "S.....\n....T.\n...TG.\n....T.\n......\n", 0.0, 0.0]]
}
GAMMA = 0.9
RUNS = {  # as in the sheet
    "ppo": ["agent=ppo_sb3_defaults", "total_timesteps=8192"],
    "sarsa": [
        *("agent=sarsa", "env=cliff", "tuned=none", "total_timesteps=30000"),
        *("agent.exploration_initial_eps=0.3", "agent.exploration_final_eps=0.3"),
    ],
    "q_learning": ["agent=q_learning", "agent.learning_rate=0.001"],
}
BOUNDS = {  # of the settings of the remedy
    "total_timesteps": (1_000, 200_000),
    "n_envs": (1, 256),
    "exploration_bonus": (0, 1),
    "agent.n_steps": (16, 2048),
    "agent.batch_size": (512, 65_536),
    "agent.n_epochs": (1, 10),
    "agent.learning_rate": (0.0001, 0.1),
    "agent.ent_coef": (0, 1),
    "agent.gamma": (0.9, 0.99),
}
SEEDS = range(3)


def worlds() -> Iterator[Mdp]:
    for name, text, slip, step_reward in PUBLIC["worlds"]:
        yield compile_mdp(parse(text, name), slip=slip, step_reward=step_reward)


def random_policy(mdp: Mdp) -> np.ndarray:
    return np.random.default_rng(0).dirichlet(np.ones(mdp.num_actions), mdp.num_states)


def compare(function: str, found: np.ndarray, exact: np.ndarray, mdp: Mdp, tolerance: float = 1e-8) -> None:
    error = np.abs(found - exact)
    error[~mdp.reachable] = 0.0
    if not error.max() <= tolerance:
        state = int(np.unravel_index(error.argmax(), error.shape)[0])
        raise WrongAnswerError(f"`{function}` is wrong by {error.max():.2g} in state {state} of {mdp.name}")


def start_value(mdp: Mdp, policy: np.ndarray) -> float:
    return float(mdp.start @ Chain(mdp, policy).value(GAMMA))


@exercise("3.1 where episodes end", points=2)
def where_episodes_end(work: Work) -> str:
    for mdp in worlds():
        policy = random_policy(mdp)
        after_many = np.linalg.matrix_power(Chain(mdp, policy).transition, 2**20)
        found = work.array("end_probabilities", mdp, policy, shape=(mdp.num_states,))
        compare("end_probabilities", found, mdp.start @ after_many, mdp)
    return "right in all worlds"


@exercise("3.2 advantages", points=2)
def all_advantages(work: Work) -> str:
    for mdp in worlds():
        v = Chain(mdp, random_policy(mdp)).value(GAMMA)
        found = work.array("advantages", mdp, v, GAMMA, shape=mdp.next_state.shape[:2])
        compare("advantages", found, backup(mdp, v, GAMMA) - v[:, None], mdp)
    return "right in all worlds"


@exercise("3.3 discounted visits", points=3)
def discounted_visits(work: Work) -> str:
    for mdp in worlds():
        policy = random_policy(mdp)
        exact, now = np.zeros(mdp.num_states), mdp.start
        for _ in range(500):
            exact, now = exact + now * ~mdp.terminal, GAMMA * now @ Chain(mdp, policy).transition
        compare("visits", work.array("visits", mdp, policy, GAMMA, shape=exact.shape), exact, mdp)
    return "right in all worlds"


@exercise("3.4 policy gradient", points=4)
def gradient(work: Work) -> str:
    """Compared with differences of exact values."""
    for mdp in worlds():
        theta, step = np.random.default_rng(1).normal(size=mdp.next_state.shape[:2]), 1e-4
        exact = np.zeros(theta.shape)
        for place in np.ndindex(*theta.shape):
            values = []
            for sign in (1, -1):
                moved = theta.copy()
                moved[place] += sign * step
                values.append(start_value(mdp, np.exp(moved) / np.exp(moved).sum(axis=1, keepdims=True)))
            exact[place] = (values[0] - values[1]) / (2 * step)
        found = work.array("policy_gradient", mdp, theta, GAMMA, shape=theta.shape)
        compare("policy_gradient", found, exact, mdp, tolerance=1e-6)
    return "agrees with differences of exact values"


@exercise("3.5 where the regret comes from", points=3)
def split(work: Work) -> str:
    for mdp in worlds():
        best, rng = solved(mdp, GAMMA), np.random.default_rng(2)
        worse = rng.random(mdp.num_states) < 0.4
        actions = np.where(worse, rng.integers(0, 4, mdp.num_states), best.q.argmax(axis=1))
        policy = np.eye(4)[actions]
        found = work.array("regret_split", mdp, actions, best.q, GAMMA, shape=(mdp.num_states,))
        lost, passed = best.v - best.q[np.arange(len(actions)), actions], np.zeros(mdp.num_states)
        now = mdp.start
        for _ in range(500):
            passed, now = passed + now * ~mdp.terminal, GAMMA * now @ Chain(mdp, policy).transition
        compare("regret_split", found, passed * lost, mdp)
        regret = Evaluator(mdp, GAMMA, 100).score(policy).regret
        if not abs(found.sum() - regret) <= 1e-8:
            raise WrongAnswerError(f"the shares of `regret_split` do not sum to the regret in {mdp.name}")
    return "right in all worlds, and sums to the regret"


@cache
def cause(words: tuple[str, ...]) -> str | None:
    """Trained once for a whole class."""
    return gridworld.diagnose(gridworld.train(*words, progress=False)).cause


@exercise("3.6 causes", points=3)
def causes(work: Work) -> str:
    found = work.value("CAUSES")
    for name, words in RUNS.items():
        if not found.get(name):
            raise WrongAnswerError(f"`CAUSES` names none for {name}")
        if found[name] != cause(tuple(words)):
            raise WrongAnswerError(
                f"`CAUSES` has {str(found[name])[:20]} for {name}; `diagnose` says otherwise"
            )
    return "all three as `diagnose` finds them"


@exercise("3.7 remedy", points=3)
def remedy(work: Work) -> str:
    found, words = work.value("REMEDY"), []
    for name, value in found.items():
        if name not in BOUNDS:
            raise WrongAnswerError(f"`REMEDY` may not change {name[:40]}")
        low, high = BOUNDS[name]
        if type(value) not in (int, float) or not low <= value <= high:
            raise WrongAnswerError(f"`REMEDY`: {name} must be a number from {low:g} to {high:g}")
        words.append(f"{name}={value}")
    if "agent.batch_size" not in found:
        raise WrongAnswerError("`REMEDY` must set agent.batch_size")
    for seed in SEEDS:
        settings = ("agent=ppo_sb3_defaults", "evaluation.stop_after=1", *words)
        try:
            summary = gridworld.train(*settings, seed=seed, progress=False).summary
        except InputError as error:
            raise WrongAnswerError(f"`REMEDY`: {error}") from None
        if not summary["certified"]:
            raise WrongAnswerError(
                f"with `REMEDY`, seed {seed} ends with a regret of {summary['regret']:.2g}"
            )
    return "certified on three seeds"
