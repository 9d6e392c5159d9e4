"""`examine` says what it counted, and finds faults of each kind in more than one form."""

import re
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Tuple
from helpers.faulty_envs import Result, Slippery, Start, Walk, WrongGoal
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.vec_env import DummyVecEnv

from gridworld.examining.examine import ExamineResult, examine
from gridworld.examining.sampling import Actions, sample

STEPS = 2_000


def fact(result: ExamineResult, label: str) -> str:
    return dict(result.facts)[label]


def evidence(result: ExamineResult, topic: str) -> str:
    return " ".join(each.evidence for each in result.findings if each.topic == topic)


class Ends(Walk):
    """Begins in the middle; both ends are over, and pay as much as `pays` has for them and for a step."""

    size: int = 3
    pays: ClassVar[tuple[float, float, float]] = (-0.3, 0.0, 1.0)

    def reset(self, **kwargs: Any) -> Start:
        super().reset(**kwargs)
        self.place = self.size // 2
        return self.show(), {}

    def over(self) -> bool:
        return self.place in (0, self.size - 1)

    def pay(self, action: Any) -> float:
        return self.pays[0 if self.place == 0 else 1 + (self.place == self.size - 1)]


class CostlyEnds(Ends):
    size, pays = 5, (-0.3, -1.0, 1.0)


class LastChance(Ends):
    size, pays = 5, (0.5, 0.1, 1.0)


@pytest.mark.parametrize("env", [Ends, CostlyEnds])
def test_only_what_is_called_the_reward_is_counted(env: Any) -> None:
    """By symmetry half of the episodes end on the right; those on the left pay more than a step, too."""
    assert fact(examine(env, steps=STEPS), "random policy").endswith("in 50.000% of its episodes (exact)")


def test_several_rewards_are_named_by_what_they_are_above() -> None:
    text = fact(examine(LastChance, steps=STEPS), "random policy")
    assert text.startswith("comes to a reward above 0.1, 2 steps away at the soonest, in ")


class Coin(Walk):
    """Any action reaches the goal, of which a draw is one time in five too little, at most eight times."""

    size, limit = 2, 8

    def move(self, action: Any) -> None:
        self.place = int(self.np_random.integers(5) > 0)


class Straight(Walk):
    """The reward comes after five steps, whatever is done."""

    def move(self, action: Any) -> None:
        self.place += 1


def test_a_probability_is_never_rounded_to_1() -> None:
    assert f"{1 - 0.2**8:.4%}" == "99.9997%"
    assert "in 99.9997% of its episodes (exact)" in fact(examine(Coin, steps=STEPS), "random policy")
    assert "5 steps away at the soonest, in every episode" in fact(
        examine(Straight, steps=STEPS), "random policy"
    )


class Tenth(Walk):
    """One draw in ten pays at once, in an episode of one step."""

    size, limit = 2, 1

    def move(self, action: Any) -> None:
        self.place = int(self.np_random.integers(10) == 0)


def test_a_tenth_is_a_tenth() -> None:
    assert "in 10.000% of its episodes (exact)" in fact(examine(Tenth, steps=STEPS), "random policy")


class Fall(Walk):
    """A pole: its end pays -1, and every other step nothing, so that there is nothing to find."""

    def pay(self, action: Any) -> float:
        return -float(self.over())


def test_an_end_that_only_costs_is_not_called_a_reward() -> None:
    result = examine(Fall, steps=STEPS)
    assert result.passed, str(result)
    assert "on average" in fact(result, "random policy")


class Timed(Walk):
    """Pays the same at each of six steps, whatever is done, and shows what is done."""

    pays: float = -1.0
    size = 2**7

    def move(self, action: Any) -> None:
        self.place = 2 * max(self.place, 1) + int(action)

    def over(self) -> bool:
        return self.place >= 2**6

    def pay(self, action: Any) -> float:
        return self.pays


class TimedAndPaid(Timed):
    pays = 1.0


class TimedAtRandom(Timed):
    """The same, for as many steps as a reset draws, of a state that cannot be enumerated."""

    noise = 0.0

    def reset(self, **kwargs: Any) -> Start:
        super().reset(**kwargs)
        self.observation_space = Box(0.0, 9.0, (2,), np.float64)
        self.left, self.noise = int(self.np_random.integers(3, 6)), self.np_random.uniform()
        return self.show(), {}

    def show(self) -> Any:
        return np.array([self.noise, getattr(self, "left", 0)])

    def move(self, action: Any) -> None:
        self.left -= 1
        self.noise = (self.noise + 0.3 * int(action)) % 1.0

    def over(self) -> bool:
        return self.left == 0


@pytest.mark.parametrize("env", [Timed, TimedAndPaid, TimedAtRandom])
def test_where_every_step_pays_alike_whatever_is_done_it_is_said(env: Any) -> None:
    result = examine(env, steps=STEPS)
    assert result.topics == ["reward"], str(result)


def test_where_every_step_costs_alike_and_acting_ends_it_sooner_nothing_is_found() -> None:
    class Sooner(Walk):
        def pay(self, action: Any) -> float:
            return -1.0

    result = examine(Sooner, steps=STEPS)
    assert result.passed, str(result)
    assert fact(result, "rewards") == "always -1"
    assert fact(result, "random policy").startswith("comes to an end, 5 steps away at the soonest")


def test_a_world_that_is_not_finite_is_called_continuous_and_its_space_is_shown_whole() -> None:
    result = examine("CartPole-v1", steps=STEPS)
    assert "continuous: only finite worlds have an exact optimum" in fact(result, "states")
    space = " ".join(str(gym.make("CartPole-v1").observation_space).split())
    assert fact(result, "observations").endswith(space)
    assert max(map(len, str(result).splitlines())) <= 100


def test_what_cannot_be_enumerated_says_why_as_other_commands_do() -> None:
    assert "its actions are Box(-2.0, 2.0, (1,), float32)" in fact(
        examine("Pendulum-v1", steps=200), "states"
    )


class Shows(Walk):
    """Shows its place by a function, and takes actions of a space."""

    space: ClassVar[Any] = Discrete(6)

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = self.space

    def move(self, action: Any) -> None:
        super().move(int(np.max(action)) == int(np.max(getattr(self.action_space, "start", 0))) + 1)


class ActsFromOne(Shows):
    action_space = Discrete(2, start=1)


class ActsFromMinusOne(Shows):
    action_space = MultiDiscrete([2], start=[-1])


class ShowsFromThree(Shows):
    space = Discrete(6, start=3)

    def show(self) -> Any:
        return self.place + 3


class ShowsFromThreeInADict(ShowsFromThree):
    space = Dict({"place": ShowsFromThree.space})

    def show(self) -> Any:
        return {"place": self.place + 3}


class ShowsFromThreeInATuple(ShowsFromThree):
    space = Tuple([Discrete(6), MultiDiscrete([6], start=[3])])

    def show(self) -> Any:
        return self.place, np.array([self.place + 3])


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (ActsFromOne, "actions are Discrete(2, start=1), but SB3 sends numbers from 0"),
        (ActsFromMinusOne, "actions are MultiDiscrete([2], start=[-1]), but SB3 sends"),
        (ShowsFromThree, "observations are Discrete(6, start=3), but SB3 encodes"),
        (ShowsFromThreeInADict, "observations['place'] are Discrete(6, start=3), but"),
        (ShowsFromThreeInATuple, "observations[1] are MultiDiscrete([6], start=[3]), but"),
    ],
)
def test_spaces_that_do_not_begin_at_0_are_found(env: Any, words: str) -> None:
    result = examine(env, steps=STEPS)
    assert words in evidence(result, "space"), str(result)
    assert result.topics == ["space"]


class Codes(Shows):
    """Codes up to `most` in an image of three axes."""

    most = 10
    space = Box(0, 255, (2, 3, 1), np.uint8)

    def show(self) -> Any:
        shown = np.zeros((2, 3, 1), np.uint8)
        shown.flat[self.place] = self.most
        return shown


class CodesInADict(Codes):
    space = Dict({"image": Codes.space, "place": Discrete(6)})

    def show(self) -> Any:
        return {"image": super().show(), "place": self.place}


class LargeCodes(Codes):
    """More numbers than are looked at one by one."""

    space = Box(0, 255, (20, 20, 3), np.uint8)

    def show(self) -> Any:
        shown = np.zeros((20, 20, 3), np.uint8)
        shown.flat[self.place] = self.most
        return shown


class CodesInAFrame(Codes):
    """Beside a row of white."""

    space = Box(0, 255, (2, 6, 1), np.uint8)

    def show(self) -> Any:
        shown = np.zeros((2, 6, 1), np.uint8)
        shown[1], shown[0, self.place] = 255, self.most
        return shown


class Image(Codes):
    most = 255


class BoundedCodes(Codes):
    space = Box(0, 10, (2, 3, 1), np.uint8)


class FlatCodes(Codes):
    space = Box(0, 255, (6,), np.uint8)

    def show(self) -> Any:
        return super().show().ravel()


@pytest.mark.parametrize(
    "env", [Codes, CodesInADict, LargeCodes, CodesInAFrame, Image, BoundedCodes, FlatCodes]
)
def test_codes_that_sb3_divides_by_255_are_found_and_no_others(env: Any) -> None:
    shown, space = env().show(), env().observation_space
    if isinstance(space, Dict):
        shown, space = shown["image"], space["image"]
    numbers = preprocess_obs(torch.as_tensor(shown[None]), space)
    largest = float(numbers[numbers < 1].max())  # type: ignore[index, operator]
    result = examine(env, steps=STEPS)
    if largest > 0:
        apart = ", apart from 255," if env is CodesInAFrame else ""
        expected = f"the largest number{apart} is 10, of which {largest:.2g} is left"
        assert expected in evidence(result, "observation")
    else:
        assert result.passed, str(result)


class IntFlags(Walk):
    def over(self) -> Any:
        return int(super().over())


class ArrayFlags(Walk):
    def cut(self) -> Any:
        return np.array([super().cut()])


class ArrayRewards(Walk):
    def pay(self, action: Any) -> Any:
        return np.array([super().pay(action)])


class NumpyFlags(Walk):
    """Learners take them as what they are."""

    def over(self) -> Any:
        return np.bool_(super().over())


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (IntFlags, "returns terminated=0 of type int; must be a bool"),
        (ArrayFlags, "returns truncated=[False] of type ndarray; must be a bool"),
        (ArrayRewards, "pays an array of shape (1,); must be a number"),
        (NumpyFlags, ""),
    ],
)
def test_flags_and_rewards_of_another_type_are_named(env: Any, words: str) -> None:
    result = examine(env, steps=STEPS)
    assert words in evidence(result, "interface"), str(result)
    assert result.topics == ["interface"] * bool(words), str(result)


class ResumesWhenCut(Walk):
    """A reset puts it at the start after an end only, so that a cut episode is resumed."""

    is_over = True

    def reset(self, **kwargs: Any) -> Start:
        place = 0 if self.is_over else self.place
        super().reset(**kwargs)
        self.place, self.is_over = place, True
        return self.show(), {}

    def step(self, action: Any) -> Result:
        result = super().step(action)
        self.is_over = not result[3]
        return result


class ResumesLate(ResumesWhenCut):
    """Later than a replay takes."""

    size, limit = 16, 150


class ResumesWhenOver(ResumesWhenCut):
    """The other way round."""

    def step(self, action: Any) -> Result:
        result = super().step(action)
        self.is_over = not result[2]
        self.place = 3 if result[2] else self.place
        return result


class WithoutLimit(ResumesWhenCut):
    limit = 10**9

    def step(self, action: Any) -> Result:
        result = super().step(action)
        self.is_over = result[2]
        return result


def cut_from_outside() -> gym.Env[Any, Any]:
    return gym.wrappers.TimeLimit(WithoutLimit(), 30)


@pytest.mark.parametrize(
    ("env", "after"),
    [
        (ResumesWhenCut, "truncated"),
        (ResumesLate, "truncated"),
        (cut_from_outside, "truncated"),
        (ResumesWhenOver, "other"),
    ],
)
def test_what_a_reset_keeps_after_some_ends_only_is_found(env: Any, after: str) -> None:
    result = examine(env, steps=5_000)
    assert f"after {after}" in evidence(result, "reset"), str(result)
    assert "place is not restored by reset()" in evidence(result, "reset")
    assert fact(result, "steps").endswith("a seed does not repeat an episode")


class Robot:
    def __init__(self) -> None:
        self.place, self.looks = 0, "right"
        self.rng = np.random.default_rng()


class Warehouse(Slippery):
    """A robot in an attribute, of which a reset forgets where it looks."""

    slip, forgets = 0.0, True

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Discrete(2 * self.size)
        self.robots = [Robot(), Robot()]

    def reset(self, **kwargs: Any) -> Start:
        if not self.forgets:
            self.robots[0].looks = "right"
        return super().reset(**kwargs)

    def move(self, action: Any) -> None:
        super().move(action)
        self.robots[0].looks = "right" if action else "left"

    def show(self) -> Any:
        return self.place + self.size * (self.robots[0].looks == "left")


class InnerGenerator(Warehouse):
    slip, forgets = 0.2, False

    def draw(self) -> float:
        return float(self.robots[1].rng.random())


RNG = np.random.default_rng()


class ModulesGenerator(Slippery):
    def draw(self) -> float:
        return float(RNG.random())


class SpacesGenerator(Slippery):
    def draw(self) -> float:
        return float(self.observation_space.sample()) / 6


class SeededSpace(SpacesGenerator):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        if seed is not None:
            self.observation_space.seed(seed)
        return super().reset(seed=seed)


@pytest.mark.parametrize(
    ("env", "topic", "words"),
    [
        (Warehouse, "reset", "episodes: robots[0].looks is not restored"),
        (InnerGenerator, "seed", "draws from its generator robots[1].rng, which"),
        (ModulesGenerator, "seed", f"draws from RNG of {__name__}, which"),
        (SpacesGenerator, "seed", "draws from observation_space.sample(), which"),
        (SeededSpace, "", ""),
    ],
)
def test_what_is_kept_and_what_is_drawn_from_is_named(env: Any, topic: str, words: str) -> None:
    result = examine(env, steps=STEPS)
    assert words in evidence(result, topic), str(result)
    assert result.topics == [topic] * bool(topic)


def test_a_refusal_to_enumerate_names_the_inner_attribute_too() -> None:
    assert "same state (in robots[0].looks), so" in fact(examine(Warehouse, steps=200), "states")


@pytest.mark.parametrize("batch", [gym.vector.SyncVectorEnv, DummyVecEnv])
def test_of_a_batch_the_first_environment_is_examined(batch: Any) -> None:
    result = examine(batch([WrongGoal, WrongGoal]), steps=200)
    assert result.name == "WrongGoal"
    assert result.topics == ["reward"]


def test_the_generators_of_a_given_environments_spaces_are_left_as_they_are() -> None:
    env = SpacesGenerator()
    for space in (env.action_space, env.observation_space):
        space.seed(3)
    before = [space.np_random.bit_generator.state for space in (env.action_space, env.observation_space)]
    examine(env, steps=200)
    after = [space.np_random.bit_generator.state for space in (env.action_space, env.observation_space)]
    assert before == after


class HiddenCell(gym.Env[Any, Any]):
    """A goal in one of nine cells, drawn at a reset and never shown; to stop there is the only end."""

    action_space = Discrete(5)
    observation_space = Discrete(9)
    slip, draws = 0.0, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        self.cell, self.goal = 0, int(self.np_random.integers(1, 9))
        return 0, {}

    def step(self, action: Any) -> Result:
        if self.draws and self.np_random.random() < self.slip:
            action = self.np_random.integers(4)
        row, column = divmod(self.cell, 3)
        down, right = [(0, -1), (0, 1), (1, 0), (-1, 0), (0, 0)][int(action)]
        done = int(action) == 4 and self.cell == self.goal
        self.cell = min(max(row + down, 0), 2) * 3 + min(max(column + right, 0), 2)
        return self.cell, float(done), done, False, {}


class HiddenCellAndADraw(HiddenCell):
    draws = True


class HiddenCellWithSlip(HiddenCellAndADraw):
    slip = 0.1


class HiddenCellInTime(HiddenCellWithSlip):
    """Counts its episodes, and its steps to cut them."""

    steps = episodes = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        self.steps, self.episodes = 0, self.episodes + 1
        return super().reset(seed=seed)

    def step(self, action: int) -> Any:
        *shown, _, info = super().step(action)
        self.steps += 1
        return *shown, self.steps >= 60, info


HIDDEN = [HiddenCell, HiddenCellAndADraw, HiddenCellWithSlip, HiddenCellInTime]


@pytest.mark.slow
@pytest.mark.parametrize("env", HIDDEN)
def test_a_hidden_goal_is_named_also_where_steps_draw(env: Any) -> None:
    result = examine(lambda: gym.wrappers.TimeLimit(env(), 50), steps=STEPS)
    assert "depend on what is drawn at reset (goal), which is not observed" in evidence(result, "markov")
    assert result.topics == ["markov"]
    assert "show goal" in result.findings[0].advice


def test_a_hidden_goal_is_named_where_not_all_states_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gridworld.examining.examine._SECONDS", 0.5)
    monkeypatch.setattr("gridworld.examining.hidden._MOST_STATES", 60)
    result = examine(HiddenCellInTime, steps=STEPS)
    assert re.search(
        r"in \d of \d observations of the first \d\d states the same action has different outcomes "
        r"\(exact\): they depend on what is drawn at reset \(goal\), which is not observed",
        evidence(result, "markov"),
    )


class Pennies(gym.Env[Any, Any]):
    """A step pays 1 if the action is the side of a coin, or has its sign."""

    observation_space = Discrete(1)

    def __init__(self, actions: Any) -> None:
        self.action_space = actions

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        return 0, {}

    def step(self, action: Any) -> Result:
        coin = int(self.np_random.integers(2))
        if isinstance(self.action_space, Box):
            coin, action = 1, action[0] * self.np_random.uniform(-1, 1) > 0
        return 0, float(action == coin), True, False, {}


@pytest.mark.parametrize("actions", [Discrete(2), Box(-1, 1, (1,))])
def test_actions_are_not_the_draws_of_the_environment(actions: Any) -> None:
    steps = sample(Pennies(actions), Actions(actions, 0), STEPS, 0)
    assert steps.reward[:500].mean() == pytest.approx(0.5, abs=0.1)


class Guess(Pennies):
    """A step pays 1 if the action is the first of nine hidden digits, which rarely is 0 or 1."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        self.digits = self.np_random.integers(20, size=9)
        return 0, {}

    def step(self, action: Any) -> Result:
        return 0, float(action == self.digits[0]), True, False, {}


def test_an_action_that_rarely_matters_is_not_said_to_do_nothing() -> None:
    result = examine(lambda: Guess(Discrete(2)), steps=STEPS)
    assert result.topics == ["markov"]
    assert "depend on what is drawn at reset, which is not observed" in evidence(result, "markov")


class HiddenSide(gym.Env[Any, Any]):
    """Begins in the middle of a row with slippery cells, with the goal at an end: it shows its place only."""

    observation_space, action_space = Discrete(7), Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        self.place, self.goal = 3, 6 * int(self.np_random.integers(2))
        return self.place, {}

    def step(self, action: Any) -> Result:
        forward = bool(action) != (self.np_random.random() < 0.2)
        self.place += 1 if forward else -1
        over = self.place in (0, 6)
        return self.place, (1.0 if self.place == self.goal else -1.0) if over else 0.0, over, False, {}


def test_a_hidden_goal_is_named_where_each_observation_stands_for_one_belief() -> None:
    result = examine(HiddenSide, steps=STEPS)
    assert "7 beliefs about 10 hidden states" in fact(result, "states")
    assert "depend on what is drawn at reset (goal), which is not observed" in evidence(result, "markov")
    assert "depend on what is done, on average over what is hidden, and" in evidence(result, "reward")


class StepsOnItsOwnSample(Walk):
    """Moves where `action_space.sample()` says so."""

    limit = STEPS

    def step(self, action: Any) -> Result:
        return super().step(action if self.action_space.sample() == 0 else 0)


def test_what_a_space_draws_is_not_what_is_done() -> None:
    assert examine(StepsOnItsOwnSample, steps=STEPS).topics == ["seed"]


class Dirt(gym.Env[Any, Any]):
    """A vacuum cleaner in a row of cells, of which it does not see which are clean."""

    size = 4
    action_space = Discrete(3)

    def __init__(self) -> None:
        self.observation_space = Discrete(self.size)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        self.place, self.dirt, self.time = 0, [1.0] * self.size, 0
        return 0, {}

    def step(self, action: Any) -> Result:
        paid, self.time = 0.0, self.time + 1
        if action == 2:
            paid, self.dirt[self.place] = self.dirt[self.place], 0.0
        else:
            self.place = min(max(self.place + (1 if action else -1), 0), self.size - 1)
        return self.place, paid, not any(self.dirt), self.time >= 30, {}


class MuchDirt(Dirt):
    """More than can be enumerated."""

    size = 16


@pytest.mark.parametrize("env", [Dirt, MuchDirt])
def test_what_was_done_long_ago_is_not_called_the_time(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gridworld.examining.hidden._MOST_STATES", 1_000)
    (found,) = examine(env, steps=5_000).findings
    assert found.topic == "markov"
    assert "depend on more of the past than the step before (dirt), which" in found.evidence
    assert "add the time" not in found.advice


class BothFlags(Walk):
    """At its limit it returns both flags."""

    size = 10

    def step(self, action: Any) -> Result:
        observation, reward, over, cut, info = super().step(action)
        return observation, reward, over or cut, cut, info


def test_a_limit_with_both_flags_is_called_a_limit() -> None:
    (found,) = examine(BothFlags, steps=5_000).findings
    assert found.topic == "termination"
    assert "terminated=True and truncated=True at step 40" in found.evidence
    assert "terminated=False" in found.advice


class Mask(Walk):
    shape: tuple[int, ...] = (1, 2)

    def action_masks(self) -> Any:
        return np.ones(self.shape, np.bool_)


def test_a_mask_of_one_row_is_a_mask() -> None:
    result = examine(Mask, steps=STEPS)
    assert result.passed, str(result)
    assert "can be reached" in fact(result, "states")


class SharedRobot(Walk):
    """All environments move the robot of a default argument."""

    def __init__(self, robot: Robot = Robot()) -> None:  # noqa: B008
        super().__init__()
        self.robot = robot

    def reset(self, **kwargs: Any) -> Start:
        super().reset(**kwargs)
        self.robot.place = 0
        return self.show(), {}

    def move(self, action: Any) -> None:
        self.place = self.robot.place
        super().move(action)
        self.robot.place = self.place


class SharedList(Walk):
    """Where it is the class holds."""

    visited: ClassVar[list[int]] = []

    def reset(self, **kwargs: Any) -> Start:
        self.visited[:] = [0]
        return super().reset(**kwargs)

    def move(self, action: Any) -> None:
        self.place = self.visited[-1]
        super().move(action)
        self.visited.append(self.place)


class OwnRobot(SharedRobot):
    def __init__(self) -> None:
        super().__init__(Robot())


@pytest.mark.parametrize(
    ("env", "named"), [(SharedRobot, "robot.place"), (SharedList, "something"), (OwnRobot, "")]
)
def test_environments_that_change_each_other_are_found(env: Any, named: str) -> None:
    result = examine(env, steps=STEPS)
    assert (f"they share {named}, as of a class" in evidence(result, "reset")) == bool(named), str(result)


class PaysTotals(Walk):
    """Pays at each step what the episode has earned so far."""

    def reset(self, **kwargs: Any) -> Start:
        self.total = 0.0
        return super().reset(**kwargs)

    def earn(self, action: Any) -> float:
        return super().pay(action) - 0.1

    def pay(self, action: Any) -> float:
        self.total += self.earn(action)
        return self.total


class PaysTotalsWithSlip(PaysTotals):
    slip = 0.2


class PaysWithNoise(PaysTotals):
    """Its rewards are not a function of the step either, but no totals."""

    def pay(self, action: Any) -> float:
        return self.earn(action) + float(self.np_random.integers(3))


class PaysByAHiddenGoal(gym.Env[Any, Any]):
    """Walks on a line with noise, and pays by the distance to a goal that is not shown."""

    observation_space, action_space = Box(-2.0, 2.0, (1,), np.float32), Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        self.place, self.time, self.goal = 0.0, 0, float(self.np_random.choice([-1.0, 1.0]))
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Result:
        self.time += 1
        moved = self.place + 0.2 * float(action[0]) + 0.01 * self.np_random.normal()
        self.place = min(max(moved, -2.0), 2.0)  # where it stays, it is paid as before
        shown = np.array([self.place], np.float32)
        return shown, -abs(self.place - self.goal), False, self.time >= 30, {}


@pytest.mark.parametrize(
    ("env", "found"),
    [(PaysTotals, 1), (PaysTotalsWithSlip, 1), (PaysWithNoise, 0), (PaysByAHiddenGoal, 0)],
)
def test_rewards_that_are_totals_are_found(env: Any, found: int) -> None:
    result = examine(env, steps=STEPS)
    assert ("rewards are totals" in evidence(result, "reward")) == found, str(result)
    assert result.topics == ["reward"] * found


class Late(Walk):
    """Shows where it was before the step."""

    def step(self, action: Any) -> Result:
        before = self.show()
        return before, *super().step(action)[1:]


def test_an_observation_of_before_the_step_is_named() -> None:
    (found,) = examine(Late, steps=STEPS).findings
    assert "depend on the step before (place)" in found.evidence
    assert found.advice.endswith("if it should not, make the observation after the state changes.")


class PaysTheWay(Walk):
    """Each step to the right pays, and so does going back and forth, for ever."""

    size = 4

    def pay(self, action: Any) -> float:
        return 0.1 * bool(action) + self.over()


class PunishesSuccess(Walk):
    def pay(self, action: Any) -> float:
        return -float(self.over())


class StaysForEver(PunishesSuccess):
    def cut(self) -> bool:
        return False


class FailsRarely(Walk):
    """A step fails once in twenty: within its limit it arrives with a probability of almost 1."""

    def move(self, action: Any) -> None:
        super().move(int(action) if self.np_random.integers(20) else 0)


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (Walk, "returns 1 in 5 steps, and terminates in every episode"),
        (PaysTheWay, "returns 2.1 in 40 steps, and terminates in none of its episodes"),  # 21 go right
        (PunishesSuccess, "returns 0 in 40 steps, and terminates in none of its episodes"),
        (StaysForEver, "returns 0 in 10,000 steps, and terminates in none of its episodes"),
        (FailsRarely, "returns 1 in 5.494 steps, and terminates in practically every episode"),
    ],
)
def test_what_the_best_policy_does_is_said(env: Any, words: str) -> None:
    assert fact(examine(env, steps=STEPS), "best policy") == f"{words} (exact, for gamma=0.99)"
