"""Random environments become exact worlds, against tables written by hand; what hides chance is refused."""

import itertools
import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.toy_text import blackjack

from gridworld.base.errors import InputError
from gridworld.world.door import beliefs, known
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes
from gridworld.world.sources.environment import compile_id

GAMMA = 0.9


class World(gym.Env[Any, int]):
    """A number that `move` and `begin` change; what is seen of it, `show`, may be less."""

    observation_space: gym.Space[Any] = spaces.Discrete(100)
    size, limit, actions = 5, 0, 2
    action_space: gym.Space[Any]

    def __init__(self, render_mode: str | None = None) -> None:
        self.action_space = spaces.Discrete(self.actions)
        self.render_mode = render_mode
        self.made()

    def made(self) -> None: ...

    def begin(self) -> Any:
        return 0

    def move(self, action: int) -> tuple[Any, float, bool]:
        raise NotImplementedError

    def show(self) -> Any:
        return self.at

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.at = self.begin()
        return self.show(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.at, reward, over = self.move(action)
        return self.show(), reward, over, False, {}


@pytest.fixture
def compiled() -> Iterator[Callable[..., Mdp]]:
    made: list[str] = []

    def compile_class(kind: type[World], **kwargs: Any) -> Mdp:
        gym.register(f"{kind.__name__}-v0", entry_point=kind)
        made.append(f"{kind.__name__}-v0")
        return compile_id(made[-1], **kwargs)

    yield compile_class
    for name in made:
        gym.registry.pop(name, None)


class Inventory(World):
    """Up to four items: orders arrive at once, demand is binomial, and what is left costs."""

    actions = 3

    def move(self, action: int) -> tuple[int, float, bool]:
        stock = min(self.at + action, 4)
        sold = min(stock, int(self.np_random.binomial(3, 0.4)))
        return stock - sold, 2.0 * sold - action - 0.1 * stock, False


def _inventory() -> Iterator[tuple[int, int, float, int, float, bool]]:
    demand = [0.6**3, 3 * 0.4 * 0.36, 3 * 0.16 * 0.6, 0.4**3]
    for state, action, (wanted, chance) in itertools.product(range(5), range(3), enumerate(demand)):
        stock = min(state + action, 4)
        sold = min(stock, wanted)
        yield state, action, chance, stock - sold, 2.0 * sold - action - 0.1 * stock, False


class Orders(Inventory):
    """Demand that has no bound: Poisson's, of which at most the stock is sold."""

    def move(self, action: int) -> tuple[int, float, bool]:
        stock = min(self.at + action, 4)
        sold = min(stock, int(self.np_random.poisson(1.5)))
        return stock - sold, 2.0 * sold - action - 0.1 * stock, False


def _orders() -> Iterator[tuple[int, int, float, int, float, bool]]:
    demand = [math.exp(-1.5) * 1.5**wanted / math.factorial(wanted) for wanted in range(4)]
    for state, action in itertools.product(range(5), range(3)):
        stock = min(state + action, 4)
        for sold in range(stock + 1):
            chance = demand[sold] if sold < stock else 1 - sum(demand[:sold])
            yield state, action, chance, stock - sold, 2.0 * sold - action - 0.1 * stock, False


class Shower(World):
    """Nine temperatures: the tap turns by one, the boiler by -1, 0 or 1; it ends after the draw of a bell."""

    actions, size = 3, 9

    def begin(self) -> int:
        return int(self.np_random.integers(3, 6))

    def move(self, action: int) -> tuple[int, float, bool]:
        noise = self.np_random.choice([-1, 0, 1], p=[0.25, 0.5, 0.25])
        at = int(np.clip(self.at + action - 1 + noise, 0, 8))
        return at, 1.0 if at == 4 else -1.0, bool(self.np_random.random() < 0.1)


def _shower() -> Iterator[tuple[int, int, float, int, float, bool]]:
    turns = zip([-1, 0, 1], [0.25, 0.5, 0.25], strict=True)
    for state, action, (noise, chance) in itertools.product(range(9), range(3), turns):
        at = min(max(state + action - 1 + noise, 0), 8)
        for over, bell in ((True, 0.1), (False, 0.9)):
            yield state, action, chance * bell, at, 1.0 if at == 4 else -1.0, over


class Windy(World):
    """A 3 x 4 grid in which wind lifts by a random number of rows in the inner columns; the goal ends it."""

    actions, size = 4, 12

    def move(self, action: int) -> tuple[int, float, bool]:
        row, column = divmod(self.at, 4)
        if column in (1, 2):  # a conditional draw
            row -= int(self.np_random.random() * 3) if column == 2 else int(self.np_random.random() < 0.5)
        row += (0, 1, 0, -1)[action]
        column += (1, 0, -1, 0)[action]
        at = 4 * min(max(row, 0), 2) + min(max(column, 0), 3)
        return at, -1.0, at == 11


def _windy() -> Iterator[tuple[int, int, float, int, float, bool]]:
    winds = {0: [1.0], 1: [0.5, 0.5], 2: [1 / 3] * 3, 3: [1.0]}
    for state, action in itertools.product(range(12), range(4)):
        for lifted, chance in enumerate(winds[state % 4]):
            row = min(max(state // 4 - lifted + (0, 1, 0, -1)[action], 0), 2)
            column = min(max(state % 4 + (1, 0, -1, 0)[action], 0), 3)
            yield state, action, chance, 4 * row + column, -1.0, 4 * row + column == 11


def by_hand(rows: Iterator[tuple[int, int, float, int, float, bool]], kind: type[World], start: Any) -> Mdp:
    """The world of a list of outcomes."""
    shape, filled = (kind.size, kind.actions, 8), dict[tuple[int, int], int]()
    tables = [np.zeros(shape, dtype) for dtype in (float, int, float, bool)]
    for state, action, *outcome in rows:
        column = filled.setdefault((state, action), 0)
        filled[state, action] += 1
        for table, value in zip(tables, outcome, strict=True):
            table[state, action, column] = value
    chance, following, reward, over = tables
    made = Outcomes(next_state=following, probability=chance, reward=reward, terminated=over, start=start)
    return mdp_from_outcomes("by hand", made)


def rows_of(mdp: Mdp, name: Callable[[int], Any]) -> dict[Any, dict[Any, float]]:
    """The outcomes of reachable states by what is shown of them."""
    found: dict[Any, dict[Any, float]] = {}
    for state, action in itertools.product(
        np.flatnonzero(mdp.reachable & ~mdp.terminal), range(mdp.num_actions)
    ):
        row = found.setdefault((name(state), action), {})
        for k in np.flatnonzero(mdp.probability[state, action]):
            after = int(mdp.next_state[state, action, k])
            key = name(after), float(mdp.reward[state, action, k]), bool(mdp.terminal[after])
            row[key] = row.get(key, 0.0) + float(mdp.probability[state, action, k])
    return found


def same_world(one: Mdp, other: Mdp) -> None:
    """Two worlds have the same rows, where one is known by its own observation, the other by its number."""
    assert one.own_observation is not None
    shown = one.own_observation
    mine, theirs = rows_of(one, lambda s: int(shown[s])), rows_of(other, lambda s: int(other.number[s]))
    assert mine.keys() == theirs.keys()
    for key, row in theirs.items():
        assert mine[key] == pytest.approx(row, abs=1e-12), key
    ours, given = Evaluator(one, GAMMA, 50), Evaluator(other, GAMMA, 50)
    assert ours.optimal_value == pytest.approx(given.optimal_value, abs=1e-12)


@pytest.mark.parametrize(
    ("kind", "rows", "start"),
    [
        (Inventory, _inventory, np.eye(5)[0]),
        (Orders, _orders, np.eye(5)[0]),
        (Shower, _shower, np.array([0, 0, 0, 1, 1, 1, 0, 0, 0]) / 3),
        (Windy, _windy, np.eye(12)[0]),
    ],
)
def test_custom_environments_are_their_tables(compiled: Any, kind: Any, rows: Any, start: Any) -> None:
    mdp = compiled(kind)
    of_orders = "enumerated, 5 states; poisson() without what has a chance below 1e-15"
    told = {Inventory: "enumerated, 5 states", Orders: of_orders}
    assert mdp.truth == told.get(kind, mdp.truth)
    assert "stand for several" not in mdp.truth
    same_world(mdp, by_hand(rows(), kind, start))
    assert mdp.state_name(int(mdp.start_states[0])).startswith("observation ")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "kwargs"), [("FrozenLake-v1", {}), ("FrozenLake-v1", {"desc": ["SFH", "FFG"]})]
)
def test_gymnasiums_environments_are_their_tables(env_id: str, kwargs: dict[str, Any]) -> None:
    ignore = ["P", "lastaction"]  # which the steps do not change, or not read
    mdp = compile_id(env_id, kwargs, by_table=False, ignore=ignore)
    same_world(mdp, compile_id(env_id, kwargs))
    assert mdp.action_names == ("0", "1", "2", "3")


def cards(deck: list[int], sab: bool) -> float:
    """The optimum of Blackjack by its rules: sums, aces and naturals, without a look at the environment."""
    draws = [(card, deck.count(card) / len(deck)) for card in sorted(set(deck))]

    def total(points: int, ace: bool) -> int:
        return points + 10 if ace and points <= 11 else points

    def dealer(points: int, ace: bool) -> dict[int, float]:
        if total(points, ace) >= 17:
            return {total(points, ace) if points <= 21 else 0: 1.0}
        found: dict[int, float] = {}
        for card, chance in draws:
            for result, share in dealer(points + card, ace or card == 1).items():
                found[result] = found.get(result, 0.0) + chance * share
        return found

    def stick(mine: int, up: int, natural: bool) -> float:
        value = 0.0
        for hidden, chance in draws:
            if natural and sab:
                value += chance * (sorted([up, hidden]) != [1, 10])
                continue
            for theirs, share in dealer(up + hidden, 1 in (up, hidden)).items():
                value += chance * share * ((mine > theirs) - (mine < theirs))
        return value

    memo: dict[Any, float] = {}

    def best(points: int, ace: bool, up: int, natural: bool) -> float:
        if points > 21:
            return -1.0
        key = points, ace, up, natural
        if key not in memo:
            hit = sum(chance * best(points + card, ace or card == 1, up, False) for card, chance in draws)
            memo[key] = max(hit, stick(total(points, ace), up, natural))
        return memo[key]

    return sum(
        p * q * r * best(first + second, 1 in (first, second), up, sorted([first, second]) == [1, 10])
        for (first, p), (second, q), (up, r) in itertools.product(draws, draws, draws)
    )


@pytest.mark.slow
@pytest.mark.parametrize("sab", [True, False])
def test_blackjack_with_few_cards_is_as_good_as_by_its_rules(
    sab: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    deck = [1, 7, 10, 10]
    monkeypatch.setattr(blackjack, "deck", deck)
    mdp = compile_id("Blackjack-v1", {"sab": sab})
    assert Evaluator(mdp, 1.0, 100).optimal_value == pytest.approx(cards(deck, sab), abs=1e-12)
    assert "beliefs about" in mdp.truth  # the dealer's second card is not seen
    # Where a natural wins, 21 with an ace is one observation of two states.
    assert ("observations stand for several of them" in mdp.truth) == sab
    assert mdp.own_observation is not None
    assert mdp.own_observation.shape == (mdp.num_states, 3)


def test_hands_are_summed_up_only_for_the_known_class() -> None:
    assert known.state_reader(blackjack.BlackjackEnv()) is not None
    assert known.state_reader(type("BlackjackEnv", (blackjack.BlackjackEnv,), {})()) is None


class Hidden(World):
    """Which of two doors has the prize is drawn by the reset; looking (2) tells by light or dark."""

    actions = 3

    def begin(self) -> tuple[int, int]:
        return int(self.np_random.integers(2)), 2

    def move(self, action: int) -> tuple[tuple[int, int], float, bool]:
        door, _ = self.at
        if action == 2:
            is_right = self.np_random.random() < self.clear
            return (door, door if is_right else 1 - door), -0.1, False
        return (door, 2), float(action == door), True

    clear = 1.0

    def show(self) -> int:
        return self.at[1]  # type: ignore[no-any-return]


def test_an_optimum_that_nobody_can_reach_is_not_claimed(compiled: Any) -> None:
    mdp = compiled(Hidden)
    judge = Evaluator(mdp, 1.0, 50)
    assert judge.optimal_value == pytest.approx(0.9)  # to look first; who knew the door would have 1
    assert mdp.truth == "enumerated, 4 beliefs about 2 hidden states"
    blind = np.zeros((mdp.num_states, 3))
    blind[:, 0] = 1
    assert judge.score(blind).value == 0.5


def test_beliefs_without_end_are_refused(compiled: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beliefs, "_MOST_BITS", 256)
    faint = type("Faint", (Hidden,), {"clear": 0.75})  # evidence adds up for as long as one looks
    with pytest.raises(
        InputError, match=r"has no end in the size allowed: after [\d,]+ different distributions"
    ):
        compiled(faint)


class Delayed(World):
    """A signal at the start says which action pays in the second step, where nothing of it is seen."""

    def begin(self) -> tuple[int, int]:
        return int(self.np_random.integers(2)), 0

    def move(self, action: int) -> tuple[tuple[int, int], float, bool]:
        signal, steps = self.at
        return (signal, steps + 1), float(steps == 1 and action == signal), steps == 1

    def show(self) -> int:
        return self.at[0] if self.at[1] == 0 else 2  # type: ignore[no-any-return]


def test_an_observation_of_several_beliefs_is_said(compiled: Any) -> None:
    mdp = compiled(Delayed)
    assert mdp.truth.endswith("; 1 observations stand for several of them")
    judge = Evaluator(mdp, 1.0, 50)
    assert judge.optimal_value == 1.0  # with memory
    assert mdp.own_observation is not None
    by_observation = np.eye(2)[np.where(mdp.own_observation == 2, 1, 0)]
    score = judge.score(by_observation)
    assert (score.value, score.certified) == (0.5, False)


class Coin(World):
    """Each step pays a coin's side, and shows another coin; nothing else changes."""

    def move(self, action: int) -> tuple[int, float, bool]:
        return self.at, float(self.np_random.choice([0, 4])) * action, False

    def show(self) -> int:
        return int(self.np_random.integers(3))


def test_random_rewards_and_observations(compiled: Any) -> None:
    mdp = compiled(Coin)
    assert mdp.reachable.sum() == 3
    assert Evaluator(mdp, GAMMA, 50).optimal_value == pytest.approx(2 / (1 - GAMMA))


class Named(World):
    """The generator has another name too, also in something that it holds."""

    def begin(self) -> int:
        self.rng = self.np_random
        self.held = {"again": [self.rng]}
        return 0

    def move(self, action: int) -> tuple[int, float, bool]:
        draws = self.rng.integers(2) + self.held["again"][0].integers(2)
        return int(draws), 1.0, False


def test_the_generator_may_have_other_names(compiled: Any) -> None:
    mdp = compiled(Named)
    assert sorted(mdp.probability[0, 0].tolist()) == [0.25, 0.25, 0.5]


_drawn = [0]


def _closure() -> Any:
    rng = np.random.default_rng(0)
    return lambda: rng.integers(2)


class Kinds(World):
    """Whether a list or a tuple is held is part of the state: action 1 makes a tuple, which pays once."""

    def begin(self) -> tuple[int, Any]:
        return 0, [0]

    def move(self, action: int) -> tuple[tuple[int, Any], float, bool]:
        time, held = self.at
        drawn = int(self.np_random.integers(3))
        if time == 2:
            held = (0,) if action == 1 and drawn == 0 else [0]
        paid = 10.0 * (time == 59 and action == 1 and isinstance(held, tuple))
        return (time + 1, held), paid, time == 59

    def show(self) -> int:
        return self.at[0]  # type: ignore[no-any-return]


def test_what_differs_in_type_only_may_differ_in_what_it_does(compiled: Any) -> None:
    value = Evaluator(compiled(Kinds), 1.0, 60).optimal_value
    assert value == pytest.approx(10 / 3)


_turns = itertools.cycle([0, 1])
_thread = threading.local()


def _in_turn(holder: Any) -> int:
    """0 and 1, kept where no copy is made."""
    holder.turn = 1 - getattr(holder, "turn", 0)
    return int(holder.turn)


class _Held:
    turn = 0


def _guess(number: Callable[[World], int]) -> Callable[[World, int], tuple[int, float, bool]]:
    """A step that pays for a guess of a number, after a draw that only makes it random."""
    return lambda s, a: (0 * int(s.np_random.integers(2)), float(a == number(s)), False)


def _raised(s: World, a: int) -> tuple[int, float, bool]:
    """A corridor; its right end pays, and seldom raises a level, with which it costs."""
    at, level = s.at + (1 if a else -1), vars(s).setdefault("level", 0)
    if at == 20 and s.np_random.random() < 0.05:
        s.level = 1  # type: ignore[attr-defined]
    return at, {0: 0.5 + level / 2, 20: 1.0 - 2 * level}.get(at, 0.0), at in (0, 20)


def _once(s: World) -> int:
    s.__dict__.setdefault("layout", int(s.np_random.integers(2)))
    return 0


UNSOUND: dict[str, tuple[dict[str, Any], str]] = {
    "a number": (
        {"move": lambda s, a: (0, float(s.np_random.random()), False)},
        r"used for more than comparisons .*test_chance.py:\d+",
    ),
    "a reward that is a draw": (
        {"move": lambda s, a: (0, s.np_random.random(), False)},
        r"used for more than comparisons .*test_chance.py:\d+",
    ),
    "an observation that is a draw": (
        {"move": lambda s, a: (0, 0.0, False), "show": lambda s: s.np_random.random()},
        r"used for more than comparisons .*test_chance.py:\d+",
    ),
    "a normal draw": (
        {"begin": lambda s: s.np_random.normal()},
        r"np_random.normal\(\) .*test_chance.py:\d+",
    ),
    "the state of the generator": (
        {"move": lambda s, a: (s.np_random.bit_generator.state["has_uint32"], 0.0, False)},
        "bit_generator is used",
    ),
    "a global generator in reset": (
        {"begin": lambda s: int(np.random.rand() < 0.5), "move": lambda s, a: (0, 0.0, False)},
        "another generator than",
    ),
    "a generator in a closure": (
        {"made": lambda s: setattr(s, "draw", _closure()), "move": lambda s, a: (int(s.draw()), 0.0, False)},
        "does not repeat a walk",
    ),
    "a new generator in reset": (
        {
            "begin": lambda s: s.__dict__.update(_np_random=np.random.Generator(np.random.PCG64(1))) or 0,
            "move": lambda s, a: (0, 0.0, False),
        },
        "makes another np_random",
    ),
    "a class attribute that takes turns": ({"move": _guess(lambda s: _in_turn(_Held))}, "draws otherwise"),
    "an iterator outside": ({"move": _guess(lambda s: next(_turns))}, "draws otherwise"),
    "what cannot be read outside": ({"move": _guess(lambda s: _in_turn(_thread))}, "draws otherwise"),
    "a rare end that no reset clears": (
        {"size": 21, "begin": lambda s: 10, "move": _raised},
        r"a reset does not always lead to the same state \(in level\)",
    ),
    "a layout that the first reset draws": (
        {"begin": _once, "move": _guess(lambda s: s.layout)},  # type: ignore[attr-defined]
        r"a reset does not always lead to the same state \(in layout\)",
    ),
    "a layout drawn when it is made": (
        {
            "made": lambda s: setattr(s, "layout", int(s.np_random.integers(2))),
            "move": lambda s, a: (0, float(a == s.layout), False),
        },
        "is another world each time it is made",
    ),
    "no reward": (
        {"move": lambda s, a: (0, [1.0, np.nan][s.np_random.integers(2)], False)},
        "pays nan; must be a finite",
    ),
    "too many states": (
        {"move": lambda s, a: (s.at + int(s.np_random.integers(2)), 0.0, False), "show": lambda s: 0 * s.at},
        "more than 300 states",
    ),
}


@pytest.mark.parametrize("what", UNSOUND)
def test_what_is_not_exact_is_refused(compiled: Any, what: str) -> None:
    members, reason = UNSOUND[what]
    with pytest.raises(InputError, match=f"^env.id=Unsound-v0: .*{reason}") as refused:
        compiled(type("Unsound", (World,), members), most_states=300)
    assert "\n" not in str(refused.value)


def test_draws_of_pictures_do_not_matter(compiled: Any) -> None:
    members = {"render": lambda self: self.np_random.normal(), "move": lambda self, action: (0, 1.0, False)}
    assert compiled(type("Drawn", (World,), members)).reachable.sum() == 1


SOUND: dict[str, tuple[dict[str, Any], float]] = {  # and what a step pays in the mean, with action 1
    "a generator of its own": (
        {
            "made": lambda s: setattr(s, "rng", np.random.Generator(np.random.PCG64(3))),
            "move": lambda s, a: (0, float(s.rng.integers(4) == 0), False),
        },
        0.25,
    ),
    "a method of the generator": (
        {
            "made": lambda s: setattr(s, "draw", s.np_random.integers),
            "move": lambda s, a: (0, float(s.draw(5) == 0), False),
        },
        0.2,
    ),
    "a generator that is asked for its kind": (
        {"move": lambda s, a: (0, float(isinstance(s.np_random, np.random.Generator)), False)},
        1.0,
    ),
    "a sample of the actions": ({"move": lambda s, a: (0, float(s.action_space.sample()), False)}, 0.5),
    "a draw that is kept, and not used": (
        {"move": lambda s, a: (s.__dict__.update(last=s.np_random.random()) or 0, 1.0, False)},
        1.0,
    ),
    "what a reset leaves, and nothing reads": (
        {
            "move": lambda s, a: (
                setattr(s, "luck", int(s.np_random.integers(2))) or 0,
                float(s.np_random.integers(2)),
                False,
            )
        },
        0.5,
    ),
    "what is noted elsewhere, and not read": (
        {"move": lambda s, a: (_drawn.append(0) or 0, float(s.np_random.integers(2)), False)},
        0.5,
    ),
}


@pytest.mark.parametrize("what", SOUND)
def test_what_can_be_taken_into_account_is(compiled: Any, what: str) -> None:
    members, mean = SOUND[what]
    mdp = compiled(type("Sound", (World,), members))
    assert mdp.reachable.sum() == 1
    assert (mdp.probability * mdp.reward).sum(axis=2)[mdp.start_states[0], 1] == pytest.approx(
        mean, abs=1e-12
    )


class SecondCard(gym.Env[Any, int]):
    """Keep the first of two cards, or take the second, which is shown at the end; no state changes.

    Its class takes no arguments, not even `render_mode`.
    """

    observation_space = spaces.MultiDiscrete([5, 2])
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.cards = self.np_random.choice(5, size=2, replace=False).tolist()
        return np.array([self.cards[0], 0]), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.array([self.cards[1], 1]), float(self.cards[action]), True, False, {}


def test_an_end_may_show_what_nothing_else_does(compiled: Callable[..., Mdp]) -> None:
    mdp = compiled(SecondCard)
    best = np.mean([max(first, (10 - first) / 4) for first in range(5)])
    assert Evaluator(mdp, GAMMA, 1).optimal_value == pytest.approx(best, abs=1e-12)
    assert mdp.truth == "enumerated, 10 beliefs about 20 hidden states"
