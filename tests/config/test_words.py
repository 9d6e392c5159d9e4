"""What people write on a command line: numbers such as 1e5, dashes, a plus, names that are almost right."""

from pathlib import Path

import pytest
from cases import table
from helpers.support import configure

import gridworld
from gridworld.base.errors import InputError
from gridworld.config.words import prepared, refuse_unclear


@pytest.mark.parametrize(("word", "read"), table("config/cases.txt", "whole numbers"))
def test_a_whole_number_may_be_written_as_a_float(word: str, read: str) -> None:
    assert prepared([word]) == [read]


def test_every_way_into_a_run_takes_whole_numbers(tmp_path: Path) -> None:
    """But for a yaml that Hydra reads, where the sentence says how to write one."""
    plain = gridworld.compose("agent=q_learning", total_timesteps=100_000, n_envs=8)
    (tmp_path / "experiment").mkdir()
    mine = tmp_path / "experiment" / "mine.yaml"
    mine.write_text("defaults: [{override /agent: q_learning}]\ntotal_timesteps: 1e5\nn_envs: 8.0\n")
    for words in (["agent=q_learning", "total_timesteps=1e5", {"n_envs": 8.0}], [f"recipe={mine}"]):
        config = gridworld.compose(*words)
        assert config == plain
        assert (type(config.total_timesteps), type(config.n_envs)) == (int, int)
    assert configure("agent=q_learning", "total_timesteps=1e5", "n_envs=8") == plain
    mine.write_text("# @package _global_\ntotal_timesteps: 1e5\n")
    with pytest.raises(InputError, match="write whole numbers without a decimal point or exponent"):
        gridworld.compose("experiment=mine", f"hydra.searchpath=[file://{tmp_path}]")
    mine.write_text("agent: {policy_kwargs: {net_arch: {pi: [1e1], vf: [8.0, 4]}}}\n")
    for word in (f"recipe={mine}", "agent.policy_kwargs.net_arch={pi:[1e1],vf:[8.0,4]}"):
        arch = gridworld.compose("agent=ppo", word).agent.policy_kwargs.net_arch
        assert repr(arch) == "{'pi': [10], 'vf': [8, 4]}"
    for word in ("1.5e0", "1e30"):
        with pytest.raises(InputError, match="could not be converted"):
            gridworld.compose(f"total_timesteps={word}")


def test_options_have_dashes_and_no_word_is_empty() -> None:
    """What else is refused is in commands/bad_input.txt."""
    refuse_unclear([])
    refuse_unclear(["-m", "--cfg", "job", "--config-dir=a", "--frobnicate", "--help", "agent.gamma=--seed"])
    with pytest.raises(InputError, match=r"^an empty word: is not a setting; a setting is written key=value"):
        refuse_unclear(["-m", ""])
