"""What may be wrong with an environment: a function for each thing to look at, which yields its findings.

`ALL` has them in the order of the page. Each says with numbers what is unusual, and one change to try. Where
an environment may be sound it is left alone: thresholds are wide.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from gymnasium import spaces

from gridworld.examining.hidden import hidden, hides, pays_totals
from gridworld.examining.sampling import LONGEST, parts_of
from gridworld.examining.seen import ENDINGS, ERROR, UNLIMITED, WARNING, EnvFinding, Seen
from gridworld.world.metrics import wilson_interval

_LEAST_REACHED = 1e-3  # of episodes of a random policy that come to the reward
_ALIKE = 1e-9  # returns, relative to the largest reward
_LEAST_LEFT = 0.05  # of the first reward under the discount
_LARGE, _SMALL = 1e3, 1e-3  # rewards
_DARK, _CODES = 64, 16  # the largest number of what is hardly an image, and beside 255
_LARGE_INPUT = 10.0  # root mean square of a number that is observed


def _interface(seen: Seen) -> Iterator[EnvFinding]:
    """What a step raises, and arrays that change later."""
    if failure := seen.steps.failure:
        advice = "correct that first; it may be the cause of the rest."
        yield EnvFinding("interface", ERROR, f"{failure.rstrip('.')}.", advice)
    if mistyped := seen.steps.mistyped:
        evidence = f"step() {mistyped}."
        yield EnvFinding(
            "interface", WARNING, evidence, "convert it in step(); libraries differ in what they do."
        )
    if count := seen.steps.changed:
        evidence = f"{count} of the first returned observations were changed by the next step."
        yield EnvFinding("interface", ERROR, evidence, "return a copy, e.g. self.state.copy().")


def _spaces(seen: Seen) -> Iterator[EnvFinding]:
    """Spaces that SB3 takes for something else."""
    for what, space in (("action", seen.env.action_space), ("observation", seen.env.observation_space)):
        for name, each, _ in parts_of(space):
            if isinstance(each, spaces.Discrete | spaces.MultiDiscrete) and np.any(each.start):
                does = "sends numbers from 0" if what == "action" else "encodes numbers from 0, and may fail"
                evidence = f"{what}s{name} are {each}, but SB3 {does}."
                wrapper = f"gymnasium.wrappers.Transform{what.capitalize()}"
                advice = f"let the space begin at 0 and move the numbers in step(), or use {wrapper}."
                yield EnvFinding("space", WARNING, evidence, advice)
    for name, pixels in seen.steps.pixels.items():
        largest, has_white = max(pixels - {255}, default=0), 255 in pixels
        if 0 < largest < (_CODES if has_white else _DARK):
            apart = ", apart from 255," if has_white else ""
            evidence = (
                f"observations{name} are uint8 from 0 to 255 with three axes, which SB3 takes for images and "
                f"divides by 255; the largest number{apart} is {largest}, of which {largest / 255:.2g} is "
                "left."
            )
            advice = (
                "give the Box its real bounds, show codes as one-hot vectors, or use SB3's "
                "policy_kwargs=dict(normalize_images=False)."
            )
            yield EnvFinding("observation", WARNING, evidence, advice)


def _values(seen: Seen) -> Iterator[EnvFinding]:
    """Observations outside of their space, and rewards that are no numbers."""
    if outside := seen.steps.outside:
        space = " ".join(str(seen.env.observation_space).split())[:80]
        yield EnvFinding(
            "space",
            ERROR,
            f"{len(outside):,} of {seen.observed:,} different observations are outside of {space}: one "
            f"{next(iter(outside.values()))}.",
            "correct observation_space, or what is returned, so that observation_space contains it.",
        )
    if wrong := int(np.sum(~np.isfinite(seen.steps.reward))):
        evidence = f"{wrong:,} of {len(seen.steps.reward):,} rewards are not finite."
        yield EnvFinding("reward", ERROR, evidence, "find the division or logarithm that makes them.")


def _seed(seen: Seen) -> Iterator[EnvFinding]:
    """Whether the same seed and actions give the same episode."""
    same = "the same seed and actions give another episode"
    if seen.replays.survivors:
        names = ", ".join(filter(None, seen.replays.survivors)) or "something"
        evidence = f"{same} after {seen.replays.after} episodes: {names} is not restored by reset()."
        yield EnvFinding("reset", ERROR, evidence, "set in reset() all that an episode changes.")
    elif not seen.replays.repeats:
        causes = " and ".join(seen.replays.causes) or "something else, e.g. the clock"
        evidence = f"{same}: it draws from {causes}, which reset(seed=...) does not seed."
        advice = "draw from self.np_random, and call super().reset(seed=seed) in reset()."
        yield EnvFinding("seed", WARNING, evidence, advice)
    if seen.replays.shared:
        names = ", ".join(filter(None, seen.replays.shared)) or "something"
        evidence = (
            f"another environment changes this one: they share {names}, as of a class, a module or a default "
            "argument."
        )
        advice = "create it in __init__(); batches and evaluations have several environments at a time."
        yield EnvFinding("reset", ERROR, evidence, advice)


def _ends(seen: Seen) -> Iterator[EnvFinding]:
    """Whether `terminated` and `truncated` are used rightly."""
    steps, lengths, mdp = seen.steps, seen.lengths, seen.mdp
    last = steps.last
    if (limit := seen.ends_at) is not None:
        cut = steps.truncated[last[lengths == limit]].any()
        yield EnvFinding(
            "termination",
            WARNING,
            f"{np.sum(lengths == limit)} of {len(lengths)} episodes are terminated=True "
            f"{'and truncated=True ' * bool(cut)}at step {limit}, none later, and the observation does not "
            "show the time: this is a step limit, which value functions take for the end of the task.",
            "return terminated=False and truncated=True at the limit, or use "
            f"gymnasium.wrappers.TimeLimit(env, {limit}).",
        )
    ended, is_long = steps.terminated[last] | steps.truncated[last], (lengths >= LONGEST).any()
    never = bool(not ended.any() and is_long)
    how = f"none of {len(lengths)} episodes ended in {LONGEST:,} steps"
    if mdp is not None:
        never, how = not bool(mdp.terminal[mdp.reachable].any()), "no state that can be reached is an end"
    if never and seen.limit is None:
        evidence = f"{how}, and there is no step limit: the first episode never ends."
        advice = "register it with max_episode_steps, or wrap it in gymnasium.wrappers.TimeLimit."
        yield EnvFinding("termination", ERROR, evidence, advice)
    early = ~steps.terminated[last] & steps.truncated[last] & (lengths < lengths.max(initial=0))
    paid = seen.paid[last[early]]
    if (
        not steps.terminated.any()
        and len(set(lengths[early])) > 2
        and paid.sum() >= max(ENDINGS, 0.9 * len(paid))
    ):
        yield EnvFinding(
            "termination",
            ERROR,
            f"{len(paid)} of {len(lengths)} episodes are truncated before the limit, {paid.sum()} of them as "
            "the reward comes, and none is terminated: value functions add a future that there is not.",
            "return terminated=True where the task is over, and truncated=True at the limit only.",
        )
    starts, over = np.unique(steps.before[steps.first]), steps.terminated[last] & (lengths > 1)
    like_start = len(starts) == 1 and (steps.after[last][over] == starts[0]).all() and not seen.is_constant
    if like_start and over.sum() >= ENDINGS and limit is None:
        evidence = f"all {over.sum()} terminated episodes end with the observation of the start"
        advice = "return the observation that the last action led to; the caller calls reset()."
        yield EnvFinding("termination", WARNING, f"{evidence}, as if step() had called reset().", advice)


def _actions(seen: Seen) -> Iterator[EnvFinding]:
    """Whether actions do anything, and how a Gaussian policy fits their bounds."""
    plays = seen.replays.plays
    if seen.replays.does_nothing:
        yield EnvFinding(
            "actions",
            ERROR,
            f"{len(plays[0])} sequences of actions have the same observations, rewards and ends with each of "
            f"{len(plays)} seeds: no action does anything.",
            "check that step() uses its argument, and compares it with values of the action space.",
        )
    if isinstance(box := seen.env.action_space, spaces.Box):
        low, high = box.low.astype(float).ravel(), box.high.astype(float).ravel()
        middle, half = (high + low) / 2, (high - low) / 2
        wrong = ~np.isfinite(half) | (half > 10) | (half < 0.05) | (np.abs(middle) > half)
        if wrong.any():
            place = int(np.argmax(wrong))
            yield EnvFinding(
                "actions",
                WARNING,
                f"action {place} is from {low[place]:g} to {high[place]:g}, but a Gaussian policy begins "
                "with draws around 0 of deviation 1, which are clipped to a bound or stay near one place.",
                "use Box(-1, 1) and scale the action in step(), or gymnasium.wrappers.RescaleAction.",
            )


def _reward(seen: Seen) -> Iterator[EnvFinding]:
    """Whether a reward can be found, and depends on what is done."""
    steps, mdp, plays, reach = seen.steps, seen.mdp, seen.replays.plays, seen.reach
    advice = "pay for progress, start closer to the goal, or check the conditions of reward and goal."
    rewards = [[[reward for _, reward, *_ in play] for play in of_seed] for of_seed in plays]
    are_same = bool(rewards) and all(each == of_seed[0] for of_seed in rewards for each in of_seed)
    are_over = all(any(play[-1][2:]) for of_seed in plays for play in of_seed)
    values, has_ends = np.unique(steps.reward[np.isfinite(steps.reward)]), steps.terminated.any()
    states = "" if mdp is None else f"no action in the {mdp.reachable.sum():,} reachable states"
    if (
        mdp is not None
        and seen.returns is not None
        and np.ptp(seen.returns) <= _ALIKE * np.abs(mdp.reward).max()
    ):
        paid = f"{states} pays more than {seen.usual + 0.0:g}"
        if len(values) > 1:
            paid = "rewards do not depend on what is done"
            if hides(mdp):
                paid += ", on average over what is hidden"
                advice = f"show what decides them, or {advice}"
        evidence = f"{paid}, and every policy returns {seen.returns[0] + 0.0:.4g} (exact)."
        yield EnvFinding("reward", ERROR, evidence, advice)
    elif mdp is not None and reach is None and mdp.goal.any() and not mdp.is_enumerated:
        yield EnvFinding("reward", ERROR, f"{states} reaches a goal (exact).", advice)
    elif reach is not None and reach[0] < _LEAST_REACHED:
        evidence = (
            f"a random policy comes to {seen.worth} within {seen.limit or UNLIMITED:,} steps with probability"
        )
        evidence = f"{evidence} {reach[0]:.2g} (exact); it is {reach[1]} steps away."
        yield EnvFinding("exploration", WARNING, evidence, advice)
    elif mdp is None and len(values) == 1 and not (values[0] and has_ends and len(set(seen.lengths)) > 1):
        episodes = len(np.unique(steps.episode[steps.at_random]))
        most = f"{wilson_interval(0, episodes)[1]:.1%}" if episodes else "100%"
        yield EnvFinding(
            "reward",
            ERROR,
            f"all {len(steps.reward):,} sampled steps pay {values[0]:g}, and episodes end at steps "
            f"{sorted(set(seen.lengths.tolist()))[:3]} whatever is done; a random policy finds another "
            f"in less than {most} of its episodes (95 %).",
            advice,
        )
    elif mdp is None and are_same and (len(set(rewards[0][0][1:])) > 1 or (len(values) == 1 and are_over)):
        evidence = f"{len(rewards[0])} sequences of actions are paid the same step by step, with each of"
        evidence = f"{evidence} {len(rewards)} seeds: rewards do not depend on what is done."
        advice = "compute the reward from the action, or from the state that it leads to."
        yield EnvFinding("reward", ERROR, evidence, advice)


def _scale(seen: Seen) -> Iterator[EnvFinding]:
    """Whether rewards have a usual size."""
    finite = seen.steps.reward[np.isfinite(seen.steps.reward)]
    largest = float(np.abs(finite).max(initial=0.0))
    if largest > _LARGE:
        evidence = (
            f"rewards are from {finite.min():.4g} to {finite.max():.4g}; usual settings are for about 1."
        )
        advice = f"divide them by {10.0 ** round(np.log10(largest)):g}, or use SB3's VecNormalize."
        yield EnvFinding("scale", WARNING, evidence, advice)
    elif 0 < largest < _SMALL:
        evidence = f"no reward is larger than {largest:.2g}; an entropy bonus or noise outweighs it."
        advice = f"multiply them by {10.0 ** -round(np.log10(largest)):g}, or use SB3's VecNormalize."
        yield EnvFinding("scale", WARNING, evidence, advice)


def _discount(seen: Seen) -> Iterator[EnvFinding]:
    """Whether the discount leaves something of the first reward."""
    if seen.reach is not None:
        distance: int | None = seen.reach[1]
        how = "is"
    else:  # the soonest of a sample is far from it; where held actions come to it alike, it may be it
        times = np.sort(seen.steps.time[seen.paid]) + 1
        distance = int(times[0]) if len(times) > 1 and times[0] == times[1] else None
        how = "was never sampled less than"
    if distance is not None and (left := seen.gamma**distance) < _LEAST_LEFT:
        evidence = f"the first reward {how} {distance:,} steps away: {seen.gamma:g} leaves {left:.1%} of it."
        advice = f"use gamma={1 - 1 / distance:.4g}, repeat each action for several steps, or pay on the way."
        yield EnvFinding("discount", WARNING, evidence, advice)


def _observation(seen: Seen) -> Iterator[EnvFinding]:
    """Whether observations change, and have a scale for networks."""
    steps, space = seen.steps, seen.env.observation_space
    if seen.is_constant and (seen.lengths > 1).any():
        evidence = f"all {len(steps.before):,} sampled steps show the same observation."
        advice = "return what the step changed; make the observation after the state changes."
        yield EnvFinding("observation", ERROR, evidence, advice)
    is_image = isinstance(space, spaces.Box) and len(space.shape) == 3
    if steps.vectors is None or is_image:
        return
    values = np.nan_to_num(steps.vectors[steps.before], posinf=0, neginf=0)
    sizes = np.sqrt(np.mean(values**2, axis=0))
    if sizes.max(initial=0.0) > _LARGE_INPUT:
        place = int(sizes.argmax())
        column = values[:, place]
        yield EnvFinding(
            "observation",
            WARNING,
            f"its number {place} is from {column.min():.4g} to {column.max():.4g} (mean {column.mean():.3g}, "
            f"deviation {column.std():.2g}); networks learn from numbers around 0 of size 1.",
            "subtract its mean and divide by its deviation, or use SB3's VecNormalize.",
        )


def _markov(seen: Seen) -> Iterator[EnvFinding]:
    """Whether what follows is determined by the observation and the action."""
    if is_total := pays_totals(seen):
        evidence = (
            "rewards are totals: observation, action and next observation determine what is added to the "
            "reward of the step before, but not the reward itself."
        )
        advice = "return what this step alone earned; learners add rewards up."
        yield EnvFinding("reward", ERROR, evidence, advice)
    is_known = seen.is_constant or seen.replays.survivors or is_total
    if not is_known and (found := hidden(seen)) is not None:
        yield EnvFinding("markov", WARNING, *found)


def _checker(seen: Seen) -> Iterator[EnvFinding]:
    """What Gymnasium's checker says, unless it is known better."""
    known = seen.steps.failure or seen.steps.mistyped or seen.steps.outside or not seen.replays.repeats
    if seen.interface and not known:
        advice = "correct that; gymnasium.utils.env_checker.check_env repeats the check."
        yield EnvFinding("interface", WARNING, f"{seen.interface.rstrip('.')}.", advice)


ALL: tuple[Callable[[Seen], Iterator[EnvFinding]], ...] = (
    *(_interface, _spaces, _values, _seed, _ends, _actions, _reward, _scale),
    *(_discount, _observation, _markov, _checker),
)
