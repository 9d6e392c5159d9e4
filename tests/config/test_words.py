"""What people write on a command line: numbers such as 1e5, dashes, a plus, names that are almost right."""

import re
from pathlib import Path

import pytest
from helpers.support import configure
from hydra.errors import HydraException

import gridworld
from gridworld.base.errors import InputError
from gridworld.config.words import prepared, refuse_unclear, sentence


@pytest.mark.parametrize(
    ("word", "read"),
    [
        ("total_timesteps=1e5", "total_timesteps=100000"),
        ("total_timesteps=1.5e3", "total_timesteps=1500"),
        ("++agent.batch_size=64.0", "++agent.batch_size=64"),
        ("evaluation.every=1_000.", "evaluation.every=1000"),
        ("checkpoint.every=1e3", "checkpoint.every=1000"),
        ("total_timesteps=1e3,2E3,3000", "total_timesteps=1000,2000,3000"),
        ("seed=range(0,1e1,step=2.0)", "seed=range(0,10,step=2)"),
        ("seed=-1e0", "seed=-1"),
        ("agent.policy_kwargs.net_arch=[1e2,64.]", "agent.policy_kwargs.net_arch=[100,64]"),
        ("+agent.policy_kwargs.net_arch.pi=[1e1]", "+agent.policy_kwargs.net_arch.pi=[10]"),
        ("agent.policy_kwargs.net_arch={pi:[1e1],vf:[8]}", "agent.policy_kwargs.net_arch={pi:[10],vf:[8]}"),
        ("agent.train_freq=[4e0,step]", "agent.train_freq=[4,step]"),
        ("hydra.sweeper.max_jobs=1e5", "hydra.sweeper.max_jobs=100000"),
        ("tune.trials=1e2", "tune.trials=100"),
        *((word, word) for word in ("total_timesteps=1.5e0", "seed=1e30", "seed=1e999", "seed='1e1'")),
        *((word, word) for word in ("total_timesteps=${a.1e5}", "checkpoint.every=auto", "seed=1e", "seed=")),
        *(
            (word, word)
            for word in ("env.slip=1e0", "agent.learning_rate=1e0", "env.layout=1e5", "agent=1e5")
        ),
    ],
)
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


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--seed", "3"], "--seed 3: a setting is written without dashes; write seed=3"),
        (["-m", "--seed=0,1"], "--seed=0,1: a setting is written without dashes; write seed=0,1"),
        (["--agent", "dqn", "seed=3"], "--agent dqn: a setting is written without dashes; write agent=dqn"),
        (["--n-envs", "4"], "--n-envs 4: a setting is written without dashes; write n_envs=4"),
        (["--env.slip", "seed=3"], "--env.slip: a setting is written without dashes; write env.slip=VALUE"),
        (["--experiment"], "--experiment: a setting is written without dashes; write experiment=VALUE"),
        (["--resume", "runs/a"], "--resume runs/a: a setting is written without dashes; write resume=runs/a"),
        (["-m", ""], "an empty word: is not a setting; a setting is written key=value, as in agent=dqn"),
        (["seed=3", "ppo"], "ppo: is not a setting; write agent=ppo"),
        (["--config-dir", "mine", "maze"], "maze: is not a setting; write env=maze"),
        (['"seed=1"'], '"seed=1": is in quotation marks, which the shell passed on; leave them out'),
    ],
)
def test_unclear_words_are_answered_by_what_is_right(words: list[str], told: str) -> None:
    with pytest.raises(InputError, match=f"^{re.escape(told)}$"):
        refuse_unclear(words)


def test_options_have_dashes() -> None:
    refuse_unclear([])
    refuse_unclear(["-m", "--cfg", "job", "--config-dir=a", "--frobnicate", "--help", "agent.gamma=--seed"])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("agent=dnq", "agent=dnq: no such choice; choose from a2c, .*; did you mean dqn\\?"),
        ("env=mazes", "did you mean maze\\?"),
        ("agent.lr=1", "agent.lr: no such setting of DQN; did you mean learning_rate?"),
        ("agnet=dqn", "did you mean agent\\?"),
        ("evaluation.evry=1", "did you mean every\\?"),
        ("experimnt=maze_dqn", "did you mean experiment\\?"),
        ("learning_rate=1", "no such setting; did you mean agent.learning_rate\\?"),
        ("gama=1", "did you mean agent.gamma or evaluation.gamma\\?"),
        ("agent.slip=1", "did you mean env.slip\\?"),
        ("agent=ppo agent.buffer_size=1", "no such setting of PPO; --cfg job shows all keys"),
        ("+agent=ppo", "\\+agent=ppo: agent is always chosen, .*; write agent=ppo$"),
    ],
)
def test_a_name_that_is_almost_right_is_suggested(words: str, told: str) -> None:
    with pytest.raises((InputError, HydraException)) as mistake:
        configure(*words.split())
    assert re.search(told, sentence(mistake.value))
