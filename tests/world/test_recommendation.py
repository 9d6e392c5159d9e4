"""What the tables of a world recommend: a discount with the evaluation's optimum, a scale without bias."""

import numpy as np
import pytest

from gridworld.config.worlds import MapConfig
from gridworld.errors import InputError
from gridworld.world.exact.evaluation import Evaluator
from gridworld.world.exact.solver import solved
from gridworld.world.mdp import Mdp
from gridworld.world.recommendation import clarity, clearest_gamma, has_chance, quadratic_scale

GAMMAS = (0.9, 0.95, 0.97, 0.98, 0.99)
WORLDS = [
    MapConfig(num_rows=rows, num_cols=cols, slip=slip, step_reward=step)
    for rows, cols, slip, step in [(4, 4, 0.0, 0.0), (5, 6, 0.1, 0.0), (7, 4, 0.1, -0.04), (6, 9, 0.2, -0.1)]
] + [MapConfig(layout="aima_4x3", slip=0.2, step_reward=-0.04), MapConfig(layout="four_rooms", slip=0.05)]


@pytest.mark.parametrize("config", WORLDS, ids=repr)
def test_what_is_optimal_under_the_discount_is_certified(config: MapConfig) -> None:
    mdp = config.compile()
    gamma = clearest_gamma(mdp, GAMMAS, 0.99)
    assert gamma in GAMMAS
    found, evaluator = solved(mdp, gamma).optimal, Evaluator(mdp, 0.99, 100)
    for pick in (np.argmax, lambda table, axis: table.shape[1] - 1 - np.argmax(table[:, ::-1], axis)):
        assert evaluator.score(np.eye(4)[pick(found, axis=1)]).certified
    assert clarity(mdp, gamma, 0.99) >= max(clarity(mdp, each, 0.99) for each in GAMMAS) / 2


def test_a_discount_with_another_optimum_has_no_clear_decisions() -> None:
    mdp = MapConfig(slip=0.1).compile()
    assert clarity(mdp, 0.9, 0.99) == 0 < clarity(mdp, 0.99, 0.99)


def test_a_world_without_chance_is_decided_by_differences_in_value() -> None:
    mdp = MapConfig().compile()
    gap = solved(mdp, 0.9).q[mdp.start_states[0]]
    assert clarity(mdp, 0.9, 0.99) <= (gap.max() - np.unique(gap)[-2]) / 0.01 + 1e-9
    assert not has_chance(mdp)
    assert has_chance(MapConfig(slip=0.1).compile())


def test_the_evaluations_discount_is_the_last_candidate() -> None:
    mdp = MapConfig(slip=0.2).compile()
    assert clearest_gamma(mdp, (0.9, 0.95), 0.99) == 0.99
    assert clearest_gamma(mdp, GAMMAS, 0.8) == 0.8
    with pytest.raises(InputError, match="discount"):
        clearest_gamma(mdp, GAMMAS, 2.0)


def huber_optimum(mdp: Mdp, gamma: float, scale: float) -> np.ndarray:
    """(S, A), what minimises the expected Huber loss to its own targets, by bisection."""
    q = solved(mdp, gamma).q * scale
    for _ in range(200):
        target = mdp.reward * scale + gamma * q.max(axis=1)[mdp.next_state]
        low, high = target.min(axis=2), target.max(axis=2)
        for _ in range(40):
            middle = (low + high) / 2
            slope = (mdp.probability * np.clip(middle[..., None] - target, -1, 1)).sum(axis=2)
            low, high = np.where(slope < 0, middle, low), np.where(slope < 0, high, middle)
        q = np.where(mdp.absorbing[:, None], 0.0, (low + high) / 2)
    return q / scale


def test_under_the_scale_hubers_loss_has_the_true_values_and_without_it_another_policy() -> None:
    mdp = MapConfig(num_rows=4, num_cols=4, slip=0.2).compile()
    gamma = clearest_gamma(mdp, GAMMAS, 0.99)
    scale = quadratic_scale(mdp, gamma)
    assert scale is not None
    assert 0.5 <= scale < 1
    np.testing.assert_allclose(huber_optimum(mdp, gamma, scale), solved(mdp, gamma).q, atol=1e-6)
    without = np.eye(4)[huber_optimum(mdp, gamma, 1.0).argmax(axis=1)]
    assert not Evaluator(mdp, 0.99, 100).score(without).certified


def test_rewards_stay_where_nothing_surprises() -> None:
    assert quadratic_scale(MapConfig().compile(), 0.9) is None
    assert quadratic_scale(MapConfig(slip=0.1, trap_reward=-1000.0).compile(), 0.9) == 0.01


def test_exploring_starts_reach_every_state_in_play() -> None:
    mdp = MapConfig(layout="four_rooms").compile()
    start = mdp.with_exploring_starts(0.5).start
    playing = mdp.reachable & ~mdp.absorbing
    assert start.sum() == pytest.approx(1)
    assert (start[playing] > 0).all()
    assert not start[~playing].any()
    assert start[mdp.start_states].sum() == pytest.approx(0.5 + 0.5 / playing.sum())
