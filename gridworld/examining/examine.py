"""An environment examined: what it is, and what keeps an agent from learning in it, on one page."""

from __future__ import annotations

import contextlib
import copy
import textwrap
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import check_env

from gridworld.base.bounds import STEP_LIMIT, Bounds, Discount
from gridworld.base.errors import GYMNASIUM, InputError, in_short, on_a_line
from gridworld.checking.function import SingleEnv
from gridworld.config.compose import named_world
from gridworld.config.worlds import is_id
from gridworld.envs.inspection import task_of
from gridworld.envs.observations import make_observation
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.examining.sampling import Actions, Env, Replays, generators_restored, replays, sample
from gridworld.examining.seen import ERROR, UNLIMITED, EnvFinding, Seen
from gridworld.examining.symptoms import ALL
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import Mdp
from gridworld.world.metrics import wilson_interval
from gridworld.world.sources.elsewhere import same_elsewhere
from gridworld.world.sources.environment import as_environment, make_env, step_limit

_STEPS = 20_000
_MOST_STATES = 3_000  # to enumerate
_SECONDS = 10.0  # for that
_WIDTH = 100
Make = Callable[[], Env]


@dataclass(frozen=True)
class ExamineResult:
    """What was found of an environment; its text is the page."""

    name: str
    facts: tuple[tuple[str, str], ...]  # what it is, a label and words
    findings: tuple[EnvFinding, ...]  # the likely causes first
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    @property
    def topics(self) -> list[str]:
        """What the findings are about."""
        return [each.topic for each in self.findings]

    def __str__(self) -> str:
        lines = [self.name, ""]
        for label, text in self.facts:
            lines += textwrap.wrap(f"{label:<14} {text}", _WIDTH, subsequent_indent=" " * 15)
        lines.append("")
        for number, each in enumerate(self.findings, 1):
            found = f"{number}. {each.severity}, {each.topic}: {each.evidence}"
            for text in (found, f"   Try: {each.advice}"):
                lines += textwrap.wrap(text, _WIDTH, subsequent_indent="   ", break_long_words=False)
        count = len(self.findings)
        what = f"{count} finding{'s' * (count > 1)}" if count else "no findings"
        return "\n".join([*lines, f"{self.name}: {what}, {self.seconds:.0f} s"])


def examine(env: Any, gamma: float = 0.99, *, steps: int = _STEPS, seed: int = 0) -> ExamineResult:
    """Examine an environment: what it is, and what keeps an agent from learning in it.

    It samples episodes of random, held and constant actions and replays some of them. Where the environment
    has a transition table or its states can be enumerated, what a random policy reaches is exact; elsewhere
    it is estimated.

    Args:
        env: an environment of Gymnasium, which is left as it is, or a batch, whose first is examined; a
            function or class that makes one, without arguments; or a name: an id of Gymnasium, `module:NAME`
            of a function or class, or a world of this project, e.g. cliff.
        gamma: the discount that an agent will have.
        steps: how many steps to sample.
        seed: of all that is drawn.

    Returns:
        `findings`, each with `topic`, `severity`, `evidence` and `advice`; `facts`, `passed`; its text
        is the page.

    Raises:
        InputError: no such environment, or one that cannot be made or reset.

    Example:
        >>> examine("CliffWalking-v1").passed
        True
    """
    Discount().check("gamma", gamma)
    Bounds(low=100).check("steps", steps)
    began = time.monotonic()
    with generators_restored(env), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        name, make, mdp = _subject(env)
        first = _made(name, make)
        name = type(first.unwrapped).__name__ if "<" in name else name  # of a lambda
        if problem := _first_look(first, make, seed):
            advice = "follow gymnasium.Env; gymnasium.utils.env_checker.check_env says more."
            finding = EnvFinding("interface", ERROR, problem, advice)
            return ExamineResult(name, (), (finding,), time.monotonic() - began)
        started = time.monotonic()
        found = sample(make(), Actions(first.action_space, seed), steps, seed)
        rate, replayed = len(found.before) / max(time.monotonic() - started, 1e-3), Replays()
        mdp, refusal = _exact(make) if mdp is None else (mdp, None)
        try:
            replayed = replays(make, Actions(first.action_space, seed), found, rate)
        except Exception as error:  # anybody's code
            found.failure = found.failure or f"a replayed episode raises {in_short(error)}"
        limit = step_limit(first) or (None if mdp is None else mdp.max_episode_steps)
        seen = Seen(first, make, gamma, found, replayed, _interface(make), limit, mdp, refusal)
        findings = [finding for symptom in ALL for finding in symptom(seen)]
        if mdp is not None and isinstance(env, str) and is_id(env):
            bounds = {"most_states": _MOST_STATES, "most_seconds": _SECONDS}
            try:
                seen.mdp = same_elsewhere(mdp, env, {}, time.monotonic() - began, **bounds)
            except InputError as error:
                advice = "draw from np_random only, and sort what is in a set before its order matters."
                findings.insert(0, EnvFinding("process", ERROR, f"{str(error).partition(': ')[2]}.", advice))
        facts = tuple(_facts(seen))
    return ExamineResult(name, facts, tuple(findings), time.monotonic() - began)


def _subject(env: Any) -> tuple[str, Make, Mdp | None]:
    """What to call an environment, how to make it, and its tables if it is a compiled world."""
    if isinstance(env, str):
        if is_id(env):
            make_env(env).close()
            return env, lambda: make_env(env), None
        env = named_world(env)
    if isinstance(batch := getattr(env, "__dict__", {}).get("envs"), list | tuple) and batch:
        env = batch[0]
    if isinstance(env, Mdp):
        limit, seen = env.max_episode_steps or STEP_LIMIT, make_observation(env, "none")
        return env.name, lambda: SingleEnv(GridWorldVectorEnv(mdp=env, max_episode_steps=limit), seen), env
    if isinstance(env, gym.Env):
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        try:
            copy.deepcopy(env)
        except Exception as error:  # its attributes may be anything
            reason = f"{name} cannot be copied ({in_short(error)})"
            raise InputError(f"examine: {reason}; give a function that makes it") from None
        return name, lambda: copy.deepcopy(env), None
    if callable(env):
        return getattr(env, "__name__", type(env).__name__), env, None
    kind = type(env).__name__
    raise InputError(
        f"examine: {kind} is not a single environment; give one, a function that makes one, or a name"
    )


def _made(name: str, make: Make) -> Env:
    try:
        env = make()
    except Exception as error:  # anybody's code
        reason = str(error) if isinstance(error, InputError) else f"cannot be made ({in_short(error)})"
        raise InputError(f"examine {name}: {reason}") from error
    return as_environment(f"examine {name}", env)


def _first_look(env: Env, make: Make, seed: int) -> str:
    """What is wrong with the results of reset() and step(), a sentence; "" for nothing."""
    call, action = "reset(seed=0)", next(Actions(env.action_space, seed).of_episode(0))
    try:
        result: Any = make().reset(seed=0)
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
            return f"reset() returns {on_a_line(result)}, as in the old Gym: {GYMNASIUM}."
        env.reset(seed=0)
        call = f"a step with action {action}"
        result = env.step(action)
        if not (isinstance(result, tuple) and len(result) == 5):
            return f"step() returns {on_a_line(result)}, as in the old Gym: {GYMNASIUM}."
        if np.ndim(result[1]):
            return f"{call} pays an array of shape {np.shape(result[1])}; must be a number."
        float(result[1])
    except Exception as error:  # anybody's code
        return f"{call} raises {in_short(error)}."
    return ""


def _interface(make: Make) -> str:
    try:
        check_env(make().unwrapped, skip_render_check=True, skip_close_check=True)
    except Exception as error:  # the checker asserts, and runs anybody's code
        return f"Gymnasium's check_env says: {in_short(error).removeprefix('AssertionError: ')}"
    return ""


def _exact(make: Make) -> tuple[Mdp | None, InputError | None]:
    """The tables of an environment; or None, and why it cannot be enumerated in the time for it."""
    try:
        return task_of(make(), most_states=_MOST_STATES, most_seconds=_SECONDS).mdp, None
    except InputError as error:
        return None, error
    except Exception as error:  # of anybody's code
        return None, InputError(f"env: it raises {in_short(error)}")


def _facts(seen: Seen) -> Iterator[tuple[str, str]]:
    """What the environment is, a label and words."""
    steps, mdp, lengths = seen.steps, seen.mdp, seen.lengths
    kind = "stochastic" if seen.is_stochastic else "deterministic"
    yield "steps", f"{kind}; a seed {'repeats' if seen.replays.repeats else 'does not repeat'} an episode"
    if mdp is not None:
        yield "states", f"{mdp.reachable.sum():,} can be reached; known {mdp.scope}"
    else:
        why = str(seen.refusal).partition(": ")[2]
        yield "states", f"not enumerated, so what follows is of a sample; {why}"
    starts = len(np.unique(steps.before[steps.first]))
    met = f"{seen.observed:,} different ones in {len(steps.before):,} steps, {starts:,} at the start"
    yield "observations", f"{met}; {' '.join(str(seen.env.observation_space).split())}"
    over, cut = (int(which[steps.last].sum()) for which in (steps.terminated, steps.truncated))
    limit = f"{seen.limit:,}" if seen.limit else "not known" if cut else "none seen"
    how = f"{over:,} terminated, {cut:,} truncated; step limit {limit}"
    yield "episodes", f"{len(lengths):,} of {lengths.min():,} to {lengths.max():,} steps, {how}"
    low, high, usual = (each + 0.0 for each in (steps.reward.min(), steps.reward.max(), seen.usual))
    is_usual = np.mean(steps.reward == seen.usual) >= 0.5
    mostly = f", mostly {usual:.4g}" if is_usual else ""
    yield "rewards", f"from {low:.4g} to {high:.4g}{mostly}" if low < high else f"always {usual:.4g}"
    at_random = steps.last[steps.at_random[steps.last]]
    if seen.reach is not None:
        likely, away = seen.reach
        soonest = f"{away:,} step{'s' * (away > 1)} away at the soonest"
        yield "random policy", f"comes to {seen.worth}, {soonest}, in {_episodes(likely)} (exact)"
    elif is_usual and seen.paid.any() and len(at_random):
        hits = len(np.unique(steps.episode[steps.at_random & seen.paid]))
        low, high = wilson_interval(hits, len(at_random))
        interval = f"95 % interval {_percent(low, 1)} to {_percent(high, 1)}"
        yield (
            "random policy",
            f"comes to {seen.worth} in {hits:,} of {len(at_random):,} episodes ({interval})",
        )
    else:
        returns = np.bincount(steps.episode, steps.reward)[steps.episode[at_random]]
        found = f"returns {returns.mean():.4g} on average (deviation {returns.std():.3g})"
        yield "random policy", f"{found} in {len(at_random):,} sampled episodes"
    if mdp is not None:
        with contextlib.suppress(InputError):  # there is no finite optimum
            best = Evaluator(mdp, seen.gamma, seen.limit or UNLIMITED).optimum
            earned, lasts = f"{best.expected_return + 0.0:.4g}", best.expected_length
            length = f"{lasts:,.0f}" if lasts >= 1000 else f"{lasts:.4g}"
            found = f"returns {earned} in {length} step{'s' * (length != '1')}, and terminates in"
            yield "best policy", f"{found} {_episodes(1 - best.timeout)} (exact, for gamma={seen.gamma:g})"


def _episodes(share: float) -> str:
    for bound, text in ((0.0, "none of its episodes"), (1.0, "every episode")):
        if abs(share - bound) < 1e-12:  # a percentage would have more digits than anybody reads
            return text if share == bound else f"practically {text}"
    return f"{_percent(share, 3)} of its episodes"


def _percent(share: float, decimals: int) -> str:
    """A probability with so many decimals, or with as many as distinguish it from 0 and from 1."""
    text = f"{share:.{decimals}%}"
    is_distinct = share in (0, 1) or float(text[:-1]) not in (0, 100)
    return text if is_distinct else _percent(share, decimals + 1)
