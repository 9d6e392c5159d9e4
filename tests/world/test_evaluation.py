"""Exact scores agree with played episodes and with the oracle; certificates mean what they say."""

from pathlib import Path

import numpy as np
import pytest
from helpers.oracle import World, maps
from helpers.support import configure
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.stats import binom, chi2_contingency

import gridworld
from gridworld.base.workarounds import blas_threads
from gridworld.envs import rollout
from gridworld.envs.rollout import play, sample_episodes
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.training.setup import check_settings, make_context, objective_note
from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.evaluation import Evaluator, fitting_discounts, score_of_optimum
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse, shipped_layouts
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes

CLASSIC = Evaluator(compile_mdp(load("classic")), 0.99, 100)


SLIPPERY = [("four_rooms", 0.2), ("classic", 0.5), ("frozen_lake_4x4", 2 / 3)]


@pytest.mark.slow
@pytest.mark.parametrize(("layout", "slip"), SLIPPERY)
def test_sampled_intervals_cover_at_their_rate(layout: str, slip: float) -> None:
    """Over 100 seeds; shares of rare ends, and means that these carry, may be covered more often."""
    evaluator = Evaluator(compile_mdp(load(layout), slip, step_reward=-0.01), 0.95, 60)
    policy = np.full((evaluator.mdp.num_states, 4), 0.25)
    exact, discounted = evaluator.score(policy).outcome, evaluator.discounted_return(policy)
    seeds, covered = 100, np.zeros(5)
    for seed in range(seeds):
        sampled = sample_episodes(evaluator, policy, 400, seed)
        pairs = (
            (sampled.discounted_return, discounted),
            (sampled.goal, exact.goal),
            (sampled.timeout, exact.timeout),
            (sampled.episode_return, exact.expected_return),
            (sampled.length, exact.expected_length),
        )
        covered += [estimate.low <= truth <= estimate.high for estimate, truth in pairs]
    assert (covered >= binom.ppf(1e-3, seeds, 0.95)).all(), covered / seeds


def test_equal_episodes_do_not_prove_that_all_are_equal() -> None:
    """A thousand walks without a fall leave room for one in 260."""
    evaluator = Evaluator(compile_mdp(load("classic"), slip=1e-4), 0.99, 100)
    covered = 0
    for seed in range(60):
        sampled = sample_episodes(evaluator, evaluator.optimal_policy(), 1000, seed)
        covered += (
            sampled.episode_return.low <= evaluator.optimum.expected_return <= sampled.episode_return.high
        )
    assert covered >= binom.ppf(1e-3, 60, 0.95)


def slip_table(mdp: Mdp, walked: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
    """(A, 3), how often each outcome followed each action, where the place reached tells which it was."""
    table = np.zeros((4, 3), dtype=int)
    for states, actions, reached in walked:
        outcomes = mdp.next_state[states, actions]  # (n, 3)
        is_told = np.array([len(set(row)) == 3 for row in outcomes.tolist()])
        which = (outcomes == reached[:, None]).argmax(axis=1)
        np.add.at(table, (actions[is_told], which[is_told]), 1)
    return table


def assert_independent(table: np.ndarray) -> None:
    assert table.sum() > 5000
    assert chi2_contingency(table).pvalue > 1e-4


@pytest.mark.parametrize(("layout", "slip"), SLIPPERY)
def test_slips_do_not_depend_on_sampled_actions(monkeypatch, layout: str, slip: float) -> None:
    walked: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    class Recorder(GridWorldVectorEnv):
        def step(self, actions):
            before, playing = self.states, ~self.mdp.terminal[self.states]
            answer = super().step(actions)
            walked.append((before[playing], np.asarray(actions)[playing], answer[0][playing]))
            return answer

    monkeypatch.setattr(rollout, "GridWorldVectorEnv", Recorder)
    evaluator = Evaluator(compile_mdp(load(layout), slip), 0.99, 100)
    uniform = np.full((evaluator.mdp.num_states, 4), 0.25)
    sample_episodes(evaluator, uniform, 2000, seed=7)
    assert_independent(slip_table(evaluator.mdp, walked))
    if layout == "four_rooms":
        walked.clear()
        for episode in range(150):
            play(evaluator.mdp, uniform, 100, seed=7000 + episode)
        assert_independent(slip_table(evaluator.mdp, walked))


@pytest.mark.parametrize("agent", ["dqn", "ppo", "q_learning"])
def test_slips_do_not_depend_on_the_actions_of_training(monkeypatch, agent: str) -> None:
    """SB3 seeds the action space, from which DQN explores, with the run's seed: not the environments'."""
    walked: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def watched(self, pairs):
        step = advance(self, pairs)
        walked.append((*np.divmod(pairs, 4), step.reached))
        return step

    advance = GridWorldVectorEnv._advance
    monkeypatch.setattr(GridWorldVectorEnv, "_advance", watched)
    config = configure(f"agent={agent}", "env.slip=0.3", "env=four_rooms", "total_timesteps=19200")
    if agent == "dqn":
        config.agent.learning_starts = 19_000
    mdp = config.env.compile()
    context = make_context(config, mdp)
    config.agent.build(context).learn(config.total_timesteps, lambda steps: steps + 1)
    assert_independent(slip_table(mdp, walked))


@pytest.mark.parametrize("policy", ["greedy", "sampled"])
def test_the_discounted_return_within_the_limit_equals_brute_force(policy: str) -> None:
    world = World(("S..T", ".#..", "...G"), slip=0.2, step_reward=-0.1)
    evaluator = Evaluator(compile_mdp(parse(world.text, "map"), **world.settings), 0.9, 7)
    table = evaluator.optimal_policy() if policy == "greedy" else np.full((12, 4), 0.25)
    ahead = dict.fromkeys(world.cells, 0.0)
    for _ in range(7):
        ahead = {
            cell: 0.0
            if world.ends(cell)
            else sum(table[world.state(cell)][a] * world.q(ahead, cell, a, 0.9) for a in range(4))
            for cell in world.cells
        }
    assert evaluator.discounted_return(table) == pytest.approx(ahead[0, 0], abs=1e-12)
    assert evaluator.discounted_return(table) != pytest.approx(evaluator.score(table).value, abs=1e-4)


def test_only_shortest_safe_ways_are_certified() -> None:
    best = CLASSIC.score(CLASSIC.optimal_policy())
    assert best.certified
    assert best.regret == pytest.approx(0, abs=1e-12)
    detour = np.argmax(CLASSIC.optimal_policy(), axis=1)
    detour[[0, 6, 7]] = 2, 1, 0  # down, right and up again: two steps more
    score = CLASSIC.score(one_hot_policy(detour, 4))
    assert score.outcome.goal == 1
    assert score.outcome.expected_length == 10
    assert not score.certified
    assert score.regret == pytest.approx(0.99**7 - 0.99**9)


def test_a_certificate_is_relative_on_far_goals() -> None:
    evaluator = Evaluator(compile_mdp(parse("S" + "." * 400 + "G", "corridor")), 0.95, 1000)
    right = one_hot_policy(np.full(402, 1), 4)
    assert evaluator.optimal_value == pytest.approx(0.95**400, rel=1e-9)
    assert evaluator.score(right).certified
    still = one_hot_policy(np.zeros(402, dtype=int), 4)
    assert evaluator.score(still).regret < 1e-6  # a tiny value, yet
    assert not evaluator.score(still).certified


@given(
    world=maps(),
    slip=st.sampled_from([0.0, 0.1, 0.3]),
    trap=st.sampled_from([-1.0, -1e-80, -1e80]),
    gamma=st.sampled_from([0.0, 0.9, 0.99, 1.0]),
)
@example(world=["G..S", "T.TT"], slip=0.3, trap=-1.0, gamma=0.99)
def test_where_the_optimum_earns_nothing_it_is_certified_and_nothing_is_worth_more(
    world: list[str], slip: float, trap: float, gamma: float
) -> None:
    """Penalties only: an optimum that meets none has no scale that a tolerance could be relative to."""
    mdp = compile_mdp(parse("\n".join(world), "random"), slip, 0.0, 0.0, trap)
    evaluator = Evaluator(mdp, gamma, 100)
    best = evaluator.score(evaluator.optimal_policy())
    assert best.certified
    starts = mdp.start_states
    for policy in (evaluator.optimal_policy(), np.full((mdp.num_states, 4), 0.25)):
        score = evaluator.score(policy)
        shares = score.outcome.goal, score.outcome.trap, score.outcome.timeout
        assert all(0 <= share <= 1 for share in shares)
        assert 0 <= score.outcome.expected_length <= 100
        if evaluator.solution.scale[starts].max() == 0:
            assert score.value <= 0 <= score.regret
            assert not (score.certified and gamma >= 0.9 and score.outcome.trap > 1e-9)


def test_only_rounding_is_allowed_where_the_optimum_earns_nothing() -> None:
    """A policy that falls once in a million times is not optimal, whatever a reward out of reach is."""
    outcomes = Outcomes(
        next_state=np.zeros((2, 2, 2), dtype=int),
        probability=np.array([[[1, 0], [1 - 1e-6, 1e-6]], [[1, 0], [1, 0]]]),
        reward=np.array([[[0.0, 0], [0, -1]], [[1e9, 0], [1e9, 0]]]),  # in the second no episode ever is
        terminated=np.ones((2, 2, 2), dtype=bool),
        start=np.array([1.0, 0]),
    )
    evaluator = Evaluator(mdp_from_outcomes("fall", outcomes), 0.99, 100)
    number = evaluator.mdp.num_states
    scores = [evaluator.score(one_hot_policy(np.full(number, action), 2)) for action in (0, 1)]
    assert [score.certified for score in scores] == [True, False]
    assert 0 < evaluator.tolerance < 1e-15


def test_an_episode_is_the_policys_own_walk() -> None:
    states = play(CLASSIC.mdp, CLASSIC.optimal_policy(), 100, seed=0).states
    assert states[0] == 0
    assert states[-1] == 16
    assert len(states) == 9
    still = one_hot_policy(np.zeros(30, dtype=int), 4)
    assert len(play(CLASSIC.mdp, still, 100, seed=0).states) == 101
    uniform = np.full((30, 4), 0.25)
    walks = [play(CLASSIC.mdp, uniform, 100, seed).states.tolist() for seed in (0, 0, 1)]
    assert walks[0] == walks[1] != walks[2]


def test_shares_have_intervals_even_without_a_hit() -> None:
    best = sample_episodes(CLASSIC, CLASSIC.optimal_policy(), 100, seed=0)
    assert (best.goal.mean, best.goal.high) == pytest.approx((1, 1))
    assert best.goal.low == pytest.approx(0.963, abs=1e-3)  # Wilson: 1 / (1 + 1.96² / 100)
    assert (best.trap.mean, best.trap.low) == pytest.approx((0, 0))
    assert best.trap.high == pytest.approx(0.037, abs=1e-3)


def test_intervals_of_few_episodes_are_within_what_is_possible() -> None:
    few = sample_episodes(CLASSIC, CLASSIC.optimal_policy(), 10, seed=0)
    assert (few.episode_return.mean, few.episode_return.high) == (1, 1)
    assert few.episode_return.low == pytest.approx(0.232, abs=1e-3)
    assert few.discounted_return.high == pytest.approx(0.99**7)
    assert few.length.low == 5  # the nearest trap is one down and four to the right
    never_loses = Evaluator(compile_mdp(parse("S.G", "small"), 0.0, 0.0), 0.9, 6)
    one = sample_episodes(never_loses, never_loses.optimal_policy(), 1, seed=0)
    assert f"{one.episode_return.low:.3g}" == "0"  # not -0


@pytest.mark.slow
@pytest.mark.parametrize("slip", [0.0, 0.3])
def test_the_ends_of_intervals_are_those_of_all_walks(slip: float) -> None:
    evaluator = Evaluator(compile_mdp(parse("A=5\nS.G\n.TA", "small"), slip, -0.5), 0.9, 6)
    mdp, found = evaluator.mdp, []

    def walk(state: int, steps: int, total: float, discounted: float) -> None:
        if mdp.terminal[state] or steps == 6:
            found.append((total, discounted, steps))
            return
        for action, outcome in np.argwhere(mdp.probability[state] > 0):
            paid = mdp.reward[state, action, outcome]
            following = int(mdp.next_state[state, action, outcome])
            walk(following, steps + 1, total + paid, discounted + 0.9**steps * paid)

    walk(0, 0, 0.0, 0.0)
    one = sample_episodes(evaluator, np.full((6, 4), 0.25), 1, seed=0)  # of which nothing is known
    estimates = one.episode_return, one.discounted_return, one.length
    for estimate, ends in zip(estimates, np.transpose(found), strict=True):
        assert (estimate.low, estimate.high) == pytest.approx((ends.min(), ends.max()))


@pytest.mark.parametrize("layout", shipped_layouts())
@pytest.mark.parametrize("gamma", [0.9, 1.0])
@pytest.mark.parametrize("slip", [0.0, 0.5, 1.0])
def test_the_optimal_policy_earns_its_own_certificate(layout: str, gamma: float, slip: float) -> None:
    for step_reward in (0.0, -0.1):
        evaluator = Evaluator(compile_mdp(load(layout), slip, step_reward), gamma, 200)
        assert evaluator.solution.optimal.any(axis=1).all()
        assert evaluator.score(evaluator.optimal_policy()).certified
        if slip == 0 and step_reward == 0:
            assert evaluator.optimum.goal == 1  # it gets there, and does not put it off for ever


@given(world=maps(), slip=st.sampled_from([0.0, 0.1, 0.5, 1.0]), step=st.sampled_from([0.0, -0.07, -0.25]))
def test_undiscounted_optima_end_and_certify(world: list[str], slip: float, step: float) -> None:
    mdp = compile_mdp(parse("\n".join(world), "random"), slip, step, 0.8, -0.19)
    evaluator = Evaluator(mdp, 1.0, 100)
    assert evaluator.score(evaluator.optimal_policy()).certified


@pytest.mark.parametrize("env", ["four_rooms", "maze"])
def test_a_value_has_the_same_bits_with_any_number_of_threads(env: str) -> None:
    mdp = configure(f"env={env}").env.compile()
    policy = np.random.default_rng(0).dirichlet(np.ones(mdp.num_actions), mdp.num_states)
    count, limit = blas_threads()
    before, found = count(), set()
    try:
        for threads in (1, 2, 3):
            limit(threads)
            chain = Chain(mdp, policy)
            numbers = [chain.value(0.99), chain.discounted_return(50, 0.9), chain.outcome(50).expected_return]
            found.add(b"".join(np.asarray(number).tobytes() for number in numbers))
            assert count() in (1, threads)  # it is left as it was; not every library has so many
    finally:
        limit(before)
    assert len(found) == 1


def note(*words: str) -> str | None:
    config = gridworld.compose(*words)
    return objective_note(config, check_settings(config))


def test_a_short_horizon_takes_the_near_goal() -> None:
    judge = Evaluator(compile_mdp(load("classic"), slip=0.1), 0.99, 100)
    assert score_of_optimum(judge, 0.9).regret == pytest.approx(1.1e-5, rel=0.05)
    assert not score_of_optimum(judge, 0.9).certified
    assert fitting_discounts(judge) == [0.95, 0.97, 0.99]


def test_of_equally_good_actions_the_better_one_counts() -> None:
    judge = Evaluator(compile_mdp(parse("S.G", "map")), 0.99, 100)
    assert score_of_optimum(judge, 0.0).certified  # under 0 all ways are as good
    assert fitting_discounts(judge) == [0.8, 0.9, 0.95, 0.97, 0.99]


@pytest.mark.parametrize(
    ("words", "said", "right"),
    [
        ("agent=dqn agent.gamma=0.9 env.slip=0.1", "agent.gamma=0.9: ", "agent.gamma=0.95"),
        ("agent=q_learning agent.gamma=0.5 env.slip=0.2", "agent.gamma=0.5: ", "agent.gamma=0.99"),
        (
            "agent=a2c agent.arguments.gamma=0.9 env.slip=0.1",
            "agent.arguments.gamma=0.9: ",
            "agent.arguments.gamma=0.95",
        ),
    ],
)
def test_it_is_said_with_what_would_be_right(words: str, said: str, right: str) -> None:
    found = note(*words.split())
    assert found is not None
    assert found.startswith(said)
    assert found.endswith(f"under evaluation.gamma=0.99, too much for a certificate; use {right}")
    assert note(*words.split(), right) is None


@pytest.mark.parametrize(
    ("words", "right"),
    [
        ("agent=q_learning agent.gamma=1", 0.9),
        ("agent=ppo agent.gamma=1 env=four_rooms", 0.95),
        ("agent=dqn agent.gamma=0", 0.9),
        ("agent=value_iteration agent.gamma=0", 0.9),
    ],
)
def test_a_discount_under_which_right_and_wrong_tie_is_named(words: str, right: float) -> None:
    found = note(*words.split())
    assert found is not None
    assert "are worth as much as the right ones" in found
    assert found.endswith(f"agent.gamma={right}")


@pytest.mark.parametrize(
    "words",
    [
        "agent=value_iteration agent.gamma=1",  # it takes the way to the end
        "agent=q_learning agent.gamma=1 env=cliff",  # a step costs
        "agent=q_learning agent.gamma=1 evaluation.gamma=1",
    ],
)
def test_without_a_tie_nothing_is_said_of_a_discount_of_1(words: str) -> None:
    assert note(*words.split()) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", ["agent=q_learning agent.gamma=1", "agent=dqn agent.gamma=0.5 env.slip=0.2"]
)
def test_the_note_and_the_diagnosis_name_the_same_discount(words: str) -> None:
    found = gridworld.diagnose(gridworld.train(*words.split(), "tuned=none", seed=0, progress=False))
    assert found.cause == "objective"
    assert (note(*words.split()) or "").endswith(f"use {found.first_change}")


def test_nothing_is_said_of_what_fits_or_would_take_long(tmp_path: Path) -> None:
    assert note("agent=dqn") is None
    assert note("agent=dqn", "env.slip=0.1") is None
    large = tmp_path / "large.txt"
    large.write_text("\n".join(["S" + "." * 39, *["." * 40] * 38, "." * 39 + "G"]))
    assert note("agent=q_learning", f"env.layout={large}", "env.slip=0.1", "agent.gamma=0.1") is None


def test_a_run_says_it_once(capsys: pytest.CaptureFixture[str]) -> None:
    words = "agent=q_learning env.slip=0.1 agent.gamma=0.9 total_timesteps=64 logging.tensorboard=false"
    for progress, times in ((True, 1), (False, 0)):
        gridworld.train(*words.split(), progress=progress)
        assert capsys.readouterr().err.count("too much for a certificate") == times
