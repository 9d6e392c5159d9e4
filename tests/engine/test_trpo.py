"""TRPO's natural gradients, side by side; `test_updates` has its updates beside sb3-contrib's."""

from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import TRPO
from test_populations import SMALL, Learned, alone, differences
from test_updates import ELU, LINEAR, RELU, TWO_SIZES, samples, twins

from gridworld.agents import learn_together
from gridworld.engine.networks import aligned
from gridworld.engine.trpo import conjugate_gradients


@pytest.mark.parametrize("states", [None, np.array([3, 7, 8])], ids=["all states", "some states"])
@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        *[("one_hot", RELU), ("one_hot", ELU), ("one_hot", LINEAR)],
        *[("coordinates", TWO_SIZES), ("image", {})],
    ],
    ids=str,
)
def test_products_with_the_jacobian_agree_from_both_sides(
    kind: str, arguments: dict[str, Any], states: Any
) -> None:
    """uᵀ(J v) = (uᵀJ) v, and J v is what small changes v of the weights do."""
    run, _ = twins(TRPO, kind, batch_size=64, n_steps=4, **arguments)
    for networks in run.population.all_networks:
        (outputs,) = (each.copy() for each in networks.run(states))
        change = torch.randn(networks.weights.shape, generator=torch.Generator().manual_seed(1))
        slopes = np.random.default_rng(1).normal(size=outputs.shape).astype(np.float32)
        (moved,) = networks.push(aligned(change))
        networks.backward(slopes)
        scale = float(np.abs(slopes * moved).sum())
        assert float((networks.gradients * change).sum()) == pytest.approx(
            (slopes * moved).sum(), abs=1e-5 * scale
        )
        weights, length = networks.weights.clone(), 1e-5  # little: ReLU has kinks
        networks.weights.copy_(weights + length * change)
        (ahead,) = (each.copy() for each in networks.run(states))
        networks.weights.copy_(weights - length * change)
        (behind,) = networks.run(states)
        assert np.allclose((ahead - behind) / (2 * length), moved, atol=0.02 * np.abs(moved).max())


def test_the_longest_steps_end_at_the_border_of_the_trust_region() -> None:
    """Where a step is short and nothing damps it, the divergence is what its second derivative says."""
    short = {"target_kl": 1e-4, "cg_damping": 1e-4, "cg_max_steps": 10, "line_search_shrinking_factor": 0.99}
    run, _ = twins(TRPO, "one_hot", batch_size=512, n_steps=32, **short)
    states, actions, advantages, returns = samples(run, 512)
    pairs = states * run.population.num_actions + actions
    ours: Any = run.population
    ours.update(ours.log_policy(), pairs[None], advantages[None], returns[None])
    logged = run.model.logger.name_to_value
    assert logged["train/is_line_search_success"] == 1
    assert 0.95e-4 < logged["train/kl_divergence_loss"] < 1e-4


def test_conjugate_gradients_solve_each_system_as_alone() -> None:
    """Also where one ends earlier than the others, and rows have no round length."""
    rng, width = np.random.default_rng(0), 21
    roots = rng.normal(size=(4, width, width)).astype(np.float32)
    matrices = torch.from_numpy(roots @ roots.transpose(0, 2, 1)) + 5 * torch.eye(width)
    matrices[2] = torch.eye(width)  # which takes a single step
    wanted = torch.from_numpy(rng.normal(size=(4, width)).astype(np.float32))
    guess = 1e-4 * torch.ones_like(wanted)

    def solve(rows: slice) -> torch.Tensor:
        def product(vectors: torch.Tensor) -> torch.Tensor:
            found = [matrix @ row for matrix, row in zip(matrices[rows], vectors, strict=True)]
            return aligned(torch.stack(found))

        right = product(wanted[rows])
        return conjugate_gradients(product, right, guess[rows], 60)

    solved = solve(slice(None))
    assert torch.allclose(solved, wanted, atol=1e-3)
    for row in range(4):
        assert torch.equal(solve(slice(row, row + 1))[0], solved[row])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_trust_region_that_there_is_not_ends_its_own_run() -> None:
    runs = [(*SMALL["trpo"], f"seed={seed}") for seed in range(3)]
    learned = [Learned(words) for words in runs]
    learnings = [each.learning() for each in learned]
    learned[1].agent.run.model.target_kl = -1.0  # which no settings can be
    errors = learn_together(learnings)
    assert "a weight is not finite" in str(errors[1])
    assert [differences(learned[place].found(), alone(runs[place])) for place in (0, 2)] == [[], []]
