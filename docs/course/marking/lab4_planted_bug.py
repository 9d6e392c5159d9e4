"""How Lab 4 is marked: by `check`, on the student's function in the student's process."""

from functools import cache
from pathlib import Path
from typing import Any

from grading import Work, WrongAnswerError, exercise, numbers
from grading.sheet import read_cells

import gridworld
from gridworld import Mdp
from gridworld.checking.probes import CONSTANT
from gridworld.checking.run import CheckResult

STEPS = 1500  # as in the sheet
SHEET = Path(__file__).parents[1] / f"{Path(__file__).stem}.ipynb"
# What a student's function learns in: Gymnasium's methods on a world's tables.
ENVIRONMENT = """
class _Environment:
    def __init__(self, world, limit, seed):
        import types, numpy

        self._world, self._limit, self._rng = world, limit, numpy.random.default_rng(seed)
        self.observation_space = types.SimpleNamespace(n=int(world.number.max()) + 1)
        self.action_space = types.SimpleNamespace(n=world.num_actions)

    def _draw(self, probabilities):
        return int((probabilities[:-1].cumsum() <= self._rng.random()).sum())

    def reset(self, *, seed=None):
        self._state, self._steps = self._draw(self._world.start), 0
        return int(self._world.number[self._state]), {}

    def step(self, action):
        here, k = (self._state, action), self._draw(self._world.probability[self._state, action])
        self._state, self._steps = int(self._world.next_state[here][k]), self._steps + 1
        over = bool(self._world.terminal[self._state])
        cut = not over and self._steps >= self._limit
        return int(self._world.number[self._state]), float(self._world.reward[here][k]), over, cut, {}


def _learn(name, world, limit, steps, seed, gamma):
    return globals()[name](_Environment(world, limit, seed), steps, seed, gamma)["q"]
"""


def learn(work: Work, function: str, mdp: Mdp, steps: int, seed: int, gamma: float) -> Any:
    """The table Q that a student's function returns."""
    work.begin()
    work.run(ENVIRONMENT)
    try:
        found = work.call("_learn", function, mdp, mdp.max_episode_steps, steps, seed, gamma)
    except WrongAnswerError as error:
        raise WrongAnswerError(str(error).replace("_learn", function)) from None
    return numbers(f"the q of `{function}`", found, (mdp.num_numbers, mdp.num_actions))


@cache
def checked(work: Work, function: str) -> CheckResult:
    """Check a student's function: the exact answers stay in this process."""

    def train(env: Any, total_timesteps: int, seed: int, gamma: float) -> dict[str, Any]:
        return {"q": learn(work, function, env._envs.mdp, total_timesteps, seed, gamma)}

    learn(work, function, CONSTANT, 10, 0, 0.9)  # what fails here has its own sentence
    return gridworld.check(train, steps=STEPS)


def passed(work: Work, probe: str | None = None) -> str:
    for finding in checked(work, "train").findings:
        if finding.passed is False and probe in (None, finding.name):
            raise WrongAnswerError(f"`train` fails {finding.name}: {finding.found}")
    return f"passes {probe or 'all probes'}"


@cache
def given_agent() -> list[str]:
    """The probes that the sheet's own agent fails."""
    names: dict[str, Any] = {}
    source = next(text for text in read_cells(SHEET).values() if "def train(" in text)
    exec(compile(source, SHEET.name, "exec"), names)
    return gridworld.check(names["train"], steps=STEPS).failed


@exercise("4.1 what fails", points=2)
def what_fails(work: Work) -> str:
    found, failed = work.value("FAILED"), given_agent()
    if not isinstance(found, list) or not found:
        raise WrongAnswerError("`FAILED` must be a list of names")
    if not failed:
        raise WrongAnswerError(f"the agent in {SHEET.name} was changed; work in a copy of this file")
    for name in found:
        if name not in failed:
            raise WrongAnswerError(f"the given agent does not fail {str(name)[:30]}")
    if len(set(found)) < len(failed):
        raise WrongAnswerError(f"`FAILED` has {len(set(found))} of the {len(failed)} probes that fail")
    return "right"


@exercise("4.2 truncation", points=4)
def truncation(work: Work) -> str:
    return passed(work, "truncation")


@exercise("4.3 stochastic", points=4)
def stochastic(work: Work) -> str:
    return passed(work, "stochastic")


@exercise("4.4 trap", points=4)
def trap(work: Work) -> str:
    return passed(work, "trap")


@exercise("4.5 all probes", points=3)
def all_probes(work: Work) -> str:
    return passed(work)


@exercise("4.6 a bug of your own", points=3)
def own_bug(work: Work) -> str:
    failed = checked(work, "broken_train").failed
    if len(failed) != 1:
        raise WrongAnswerError(f"`broken_train` fails {len(failed)} probes, must be exactly one")
    if failed[0] in given_agent():
        raise WrongAnswerError(f"`broken_train` fails {failed[0]}, as the given agent does; choose another")
    return f"fails {failed[0]}, and nothing else"
