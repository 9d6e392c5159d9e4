"""Runs that train as one population: each is, bit for bit, the run that it would have been alone."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from helpers.support import configure

from gridworld.agents import Learning, learn_together
from gridworld.engine import population
from gridworld.training.setup import check_settings, make_context

Words = tuple[str, ...]
Found = dict[str, Any]

DQN = (
    *("agent=dqn", "n_envs=2", "total_timesteps=240", "agent.learning_starts=60", "agent.train_freq=4"),
    *("agent.gradient_steps=3", "agent.batch_size=24", "agent.buffer_size=150", "agent.log_interval=2"),
)
COUNTS = "gridworld.agents.sb3.replay_counts.ReplayCounts"
SMALL: dict[str, Words] = {
    "dqn": (*DQN, "agent.replay_buffer_class=null"),
    "dqn that counts": (*DQN, f"agent.replay_buffer_class={COUNTS}"),
    "qrdqn": (
        *("agent=qrdqn", "total_timesteps=160", "n_envs=4", "+agent.arguments.learning_starts=40"),
        *("agent.arguments.gradient_steps=2", "agent.arguments.batch_size=16"),
        "agent.arguments.policy_kwargs.n_quantiles=5",
    ),
    "ppo": (
        *("agent=ppo", "total_timesteps=128", "n_envs=4", "agent.n_steps=8", "agent.batch_size=8"),
        "agent.n_epochs=3",
    ),
    "a2c": ("agent=a2c", "total_timesteps=100", "n_envs=4"),
}


@dataclass
class Learned:
    """A run: what it logged, and what is called after its steps."""

    words: Words
    on_step: Callable[[int], int] = lambda steps: steps + 50
    logged: list[Any] = field(default_factory=list)
    agent: Any = None

    def learning(self) -> Learning:
        config = configure(*self.words)
        self.agent = config.agent.build(make_context(config, check_settings(config), self._log))
        return Learning(self.agent, config.total_timesteps, self.on_step)

    def _log(self, values: dict[str, Any], step: int) -> None:
        kept = sorted((key, repr(v)) for key, v in values.items() if not key.startswith("time/"))
        self.logged.append((step, kept))

    def found(self) -> Found:
        """All that learning leaves: weights, optimiser, replay, visits, what was logged, generators."""
        state = self.agent.get_state()
        del state["seconds"]
        return dict(flat({**state, "logged": self.logged}))


def flat(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield from flat(value, f"{path}.{key}")
    else:
        yield path, node.tobytes() if isinstance(node, np.ndarray) else repr(node)


def train(runs: Sequence[Learned]) -> list[Found | BaseException]:
    errors = learn_together([run.learning() for run in runs])
    return [run.found() if error is None else error for run, error in zip(runs, errors, strict=True)]


def alone(words: Words) -> Found | BaseException:
    return train([Learned(words)])[0]


def together(runs: Sequence[Words]) -> list[Found | BaseException]:
    return train([Learned(words) for words in runs])


def differences(one: Found | BaseException, other: Found | BaseException) -> list[str]:
    if isinstance(one, BaseException) or isinstance(other, BaseException):
        return [] if repr(one) == repr(other) else [f"{one!r:.200} and {other!r:.200}"]
    return [key for key in sorted(one.keys() | other.keys()) if one.get(key) != other.get(key)]


def assert_as_alone(runs: Sequence[Words]) -> None:
    for words, mine in zip(runs, together(runs), strict=True):
        theirs = alone(words)
        assert isinstance(theirs, dict), theirs
        assert differences(mine, theirs) == [], words


@pytest.fixture
def meetings(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many runs each population had that learned."""
    sizes: list[int] = []
    learn = population.Population.learn

    def counted(self: population.Population, total_timesteps: int) -> None:
        sizes.append(len(self.runs))
        learn(self, total_timesteps)

    monkeypatch.setattr(population.Population, "learn", counted)
    return sizes


# Arguments of which each run of a population may have its own; those of one place go together.
OF_DQN = [
    ("learning_rate=lin_0.01", "learning_rate=1e-4", ""),
    ("gamma=0.5", "gamma=1", ""),
    ("exploration_fraction=0.3", "exploration_final_eps=0.5", "exploration_initial_eps=0.2"),
    ("max_grad_norm=0.01", "max_grad_norm=1000", ""),
]
OF_POLICY = [("learning_rate=lin_0.01", "learning_rate=1e-4", ""), ("gamma=0.5", "gae_lambda=lin_0.9", "")]
DIFFERENT: dict[str, list[tuple[str, ...]]] = {
    "dqn": OF_DQN,
    "dqn that counts": OF_DQN,
    "qrdqn": OF_DQN,
    "ppo": [
        *OF_POLICY,
        ("ent_coef=quad_0.3", "vf_coef=2", "ent_coef=0.1"),
        ("target_kl=0.0001", "target_kl=0.003", ""),
        ("clip_range=0.01", "clip_range=lin_0.5", ""),
        ("max_grad_norm=0.01", "max_grad_norm=1000", "learning_rate=sqrt_0.01"),
    ],
    "a2c": [*OF_POLICY, ("ent_coef=0.3", "vf_coef=2", ""), ("max_grad_norm=0.01", "", "gae_lambda=0")],
}


def word(agent: str, setting: str, inside: str = "") -> Words:
    """A word of the command line that gives the agent an argument."""
    if not setting:
        return ()
    of_class = agent in ("qrdqn", "a2c")
    return (f"++agent.{'arguments.' if of_class else ''}{inside}{setting}",)


@pytest.mark.parametrize("agent", SMALL)
def test_runs_that_differ_in_all_that_may_differ(agent: str, meetings: list[int]) -> None:
    runs = [
        tuple(
            each
            for place, values in enumerate(DIFFERENT[agent])
            for each in word(agent, values[(member + place) % len(values)])
        )
        for member in range(3)
    ]
    world = ("env.slip=0.1", "exploring_starts=0.5", "stratified_draws=true", "n_envs=6")
    runs = [(*words, f"seed={n}", f"exploration_bonus={n / 4}") for n, words in enumerate(runs)]
    assert_as_alone([(*SMALL[agent], *world, *words) for words in runs])
    assert meetings == [3, 1, 1, 1]


def test_what_is_logged_of_updates_of_different_lengths_is_as_alone() -> None:
    """Sums over 32 minibatches, of which some runs end earlier; how numpy adds up depends on their number."""
    limits = ["0.0003", "0.003", "0.01", "0.03", "null", "null"]
    assert_as_alone(
        [
            (*SMALL["ppo"], "agent.n_epochs=8", f"agent.target_kl={limit}", f"seed={seed}")
            for seed, limit in enumerate(limits)
        ]
    )


# Settings of which each needs its own arrays, or its own branch of an update.
APART = {
    "ppo": [
        *("env.slip=0.1", "env.slip=0.2", "env.step_reward=-0.1", "exploring_starts=0.5", "env=cliff"),
        *("env.max_episode_steps=9", "stratified_draws=true", "n_envs=8", "total_timesteps=110"),
        *("agent.clip_range_vf=0.2", "agent.clip_range_vf=lin_1"),
    ],
    "dqn": ["agent.reward_scale=0.5", "agent.tau=0.5", f"agent.replay_buffer_class={COUNTS}", "n_envs=8"],
}


@pytest.mark.parametrize("agent", APART)
def test_runs_of_other_worlds_or_branches_train_as_alone(agent: str) -> None:
    assert_as_alone([(*SMALL[agent], each, "seed=3") for each in ["env.slip=0", *APART[agent]]])


ONE_SAMPLE = ("agent.batch_size=1", "total_timesteps=24", "agent.normalize_advantage=false")
KWARGS, LATER = "agent.policy_kwargs", "agent.arguments"
WRITTEN: dict[str, tuple[str, Words]] = {
    "ppo one step": ("ppo", ("agent.n_steps=1", "agent.batch_size=4", f"{KWARGS}.net_arch=[]")),
    "ppo one sample": ("ppo", ("agent.n_steps=2", *ONE_SAMPLE)),
    "ppo whole rollout": ("ppo", ("agent.batch_size=32", "agent.n_epochs=4", "agent.target_kl=0.002")),
    "ppo one environment": ("ppo", ("n_envs=1", "agent.n_steps=15", "agent.batch_size=5")),
    "ppo on images": ("ppo", ("observation=image", f"{KWARGS}.net_arch=[33,5,16]", "agent.n_epochs=1")),
    "ppo of two sizes": ("ppo", ("observation=coordinates", f"{KWARGS}.net_arch={{pi:[9],vf:[4,3]}}")),
    "ppo by torch": ("ppo", (f"{KWARGS}.activation_fn=torch.nn.ELU", f"{KWARGS}.net_arch=[16,16]")),
    "a2c one step": ("a2c", (f"{LATER}.n_steps=1", "total_timesteps=24")),
    "a2c scaled": ("a2c", (f"++{LATER}.normalize_advantage=true", "observation=coordinates")),
    "a2c adam": ("a2c", (f"++{LATER}.use_rms_prop=false",)),
    "dqn one sample": ("dqn", ("agent.batch_size=1", "agent.gradient_steps=1", "agent.train_freq=1")),
    "dqn many steps": ("dqn", ("agent.gradient_steps=-1", "n_envs=3", "observation=coordinates")),
    "dqn episodes": ("dqn", ("agent.train_freq=[2,episode]", "n_envs=1")),
    "dqn sgd": ("dqn", (f"{KWARGS}.optimizer_class=torch.optim.SGD", f"{KWARGS}.net_arch=[7,1]")),
    "dqn amsgrad": ("dqn", (f"+{KWARGS}.optimizer_kwargs={{amsgrad: true, weight_decay: 0.1}}",)),
    "dqn one by one": ("dqn", ("agent.target_update_interval=2", "agent.buffer_size=40", "observation=none")),
    "qrdqn one quantile": ("qrdqn", (f"{LATER}.policy_kwargs.n_quantiles=1",)),
}


ODD = ("ppo on images", "ppo of two sizes")  # a processor may add up otherwise for several of these at once


@pytest.mark.parametrize("name", WRITTEN)
def test_buffers_batches_networks_and_optimisers_of_other_kinds(name: str, meetings: list[int]) -> None:
    agent, words = WRITTEN[name]
    assert_as_alone([(*SMALL[agent], *words, f"seed={seed}") for seed in range(2)])
    if name not in ODD:
        assert max(meetings) == (1 if name in ("dqn episodes", "ppo by torch") else 2)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("agent", SMALL)
def test_one_that_diverges_fails_or_is_stopped_leaves_the_others_alone(agent: str) -> None:
    tight = word(agent, "max_grad_norm=0.01")  # gradients are clipped, too
    wild = (*SMALL[agent], *tight, "seed=1", *word(agent, "learning_rate=1e38"))
    runs = [(*SMALL[agent], *tight, f"seed={seed}") for seed in range(3)]

    def fails(steps: int) -> int:
        return 1 if steps < 60 else 1 // 0

    def stops(steps: int) -> int:
        return steps + 1 if steps < 60 else 0

    members = [Learned(runs[0]), Learned(wild), Learned(runs[1], fails), Learned(runs[2], stops)]
    first, diverged, failed, stopped, last = train([*members, Learned(runs[1])])
    assert "is not finite" in str(diverged)
    assert isinstance(failed, ZeroDivisionError)
    for found, words in ((first, runs[0]), (diverged, wild), (last, runs[1])):
        assert differences(found, alone(words)) == []
    # Nobody goes on from the environments and the replay of a run that has ended.
    left = differences(stopped, train([Learned(runs[2], stops)])[0])
    assert [name for name in left if not name.startswith((".environments", ".replay"))] == []
    assert int(stopped[".num_timesteps"]) < 70  # type: ignore[index]


def test_where_products_add_up_otherwise_runs_train_one_by_one(
    monkeypatch: pytest.MonkeyPatch, meetings: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [(*SMALL["dqn"], f"seed={seed}", "observation=coordinates") for seed in range(3)]
    expected = [alone(words) for words in runs]
    meetings.clear()
    product = torch.bmm

    def other(one: torch.Tensor, two: torch.Tensor) -> torch.Tensor:
        found = product(one, two)
        return found if len(one) == 1 else torch.nextafter(found, torch.full_like(found, torch.inf))

    monkeypatch.setattr(torch, "bmm", other)
    monkeypatch.setattr(population, "_agreed", {})
    assert [differences(*pair) for pair in zip(together(runs), expected, strict=True)] == [[]] * 3
    assert set(meetings) == {1}
    told = capsys.readouterr().err
    assert len(re.findall(r"^population: .* train one by one$", told, re.MULTILINE)) == 1
