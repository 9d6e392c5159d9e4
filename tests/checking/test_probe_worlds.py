"""The probes' worlds: their exact numbers, by hand."""

import numpy as np
import pytest

from gridworld.checking import worlds
from gridworld.checking.probes import PROBES
from gridworld.world.exact.solver import solved


def q(mdp, gamma):  # type: ignore[no-untyped-def]
    """Q* of the live states."""
    return solved(mdp, gamma).q[~mdp.terminal]


def test_their_values_are_those_that_the_page_tells() -> None:
    assert q(worlds.constant(), 0.9) == pytest.approx(1.0)
    assert q(worlds.corridor(), 0.5)[:, 0] == pytest.approx([0.25, 0.5, 1])
    assert q(worlds.bandit(), 0.9)[0] == pytest.approx([0, 1, 0.5])
    assert q(worlds.two_contexts(), 0.9) == pytest.approx(np.eye(2))
    assert q(worlds.delay(), 0.9)[0] == pytest.approx([0.9**3, 0])
    assert q(worlds.end_like_the_start(), 0.9)[:, 0] == pytest.approx([0.9, 1])
    assert q(worlds.endless(), 0.8) == pytest.approx(5)
    assert q(worlds.gamble(), 0.9)[0] == pytest.approx([0.1, 0.4])
    assert q(worlds.alternation(), 0.8)[:, 1] == pytest.approx([0.8 / 0.36, 1 / 0.36])
    assert q(worlds.trap(), 0.9)[0] == pytest.approx([0.2, 0.7])
    assert q(worlds.slippery(), 0.9)[1, 1] == pytest.approx(0.8 / 0.82)


def test_the_end_of_termination_looks_like_a_live_state() -> None:
    mdp = worlds.end_like_the_start()
    assert mdp.num_states == 3
    assert mdp.number.tolist() == [0, 1, 0]
    assert mdp.terminal.tolist() == [False, False, True]


def test_only_truncation_is_cut_before_its_values_are_settled() -> None:
    assert worlds.endless().max_episode_steps == 5
    assert not worlds.endless().terminal.any()


def test_names_are_unique_and_say_what_they_mean() -> None:
    assert len({probe.name for probe in PROBES}) == len(PROBES)
    assert all(probe.meaning and probe.holds.__doc__ and probe.world.__doc__ for probe in PROBES)
