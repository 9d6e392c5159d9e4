"""Runs that are spoilt on purpose: what was done to each, and the causes that name it.

Worlds are random maps with walls and traps, on which the unspoilt agents are certified. The rules of the
diagnosis were made on `MADE_ON`; `HELD_OUT` was chosen before anything ran on it.
"""

from dataclasses import dataclass

import numpy as np
from helpers import planted_bugs as bugs
from helpers.oracle import World

MADE_ON = (("classic", 5), ("1", 6))  # a map, and the seed of training
HELD_OUT = (("11", 101), ("12", 102), ("13", 103))
_SIZE = 5, 6


def random_map(number: str) -> str:
    """A map with a start, a goal that can be reached, walls and two traps."""
    rng = np.random.default_rng(int(number))
    while True:
        cells = rng.choice(list(".#"), size=_SIZE, p=[0.8, 0.2])
        places = rng.permutation(cells.size)[:4]
        for place, sign in zip(places, "SGTT", strict=True):
            cells.flat[place] = sign
        world = World(["".join(row) for row in cells])
        if 4 <= (world.steps_to_goal(world.starts[0]) or 0) <= 9:
            return world.text


@dataclass(frozen=True)
class Sabotage:
    """One way to spoil a run."""

    agent: str  # `q_learning`, `sarsa`, `dqn`, `ppo`, or the name of a class in `planted_bugs`
    name: str  # what was done
    words: tuple[str, ...]  # by which settings
    causes: tuple[str, ...]  # those that name it

    def __str__(self) -> str:
        return f"{self.agent}: {self.name}"

    @property
    def like(self) -> str:
        """The agent whose settings it begins with."""
        if self.agent in SOUND:
            return self.agent
        return "ppo" if issubclass(getattr(bugs, self.agent), bugs.PPO) else "dqn"

    def settings(self) -> list[str]:
        """The whole command line but for the world and the seed."""
        sound = SOUND[self.agent] if self.agent in SOUND else _of_class(self.agent, self.like)
        return [*sound, *self.words]


_DQN_WORDS = (
    "learning_rate=0.001 buffer_size=50000 batch_size=128 gamma=0.9 gradient_steps=32 "
    "target_update_interval=512 exploration_fraction=1.0"
)
_PPO_WORDS = "n_steps=32 batch_size=2048 n_epochs=5 learning_rate=0.01 ent_coef=0.5 gamma=0.95"
_DQN, _PPO = (dict(word.split("=") for word in words.split()) for words in (_DQN_WORDS, _PPO_WORDS))
_LONG = {
    "dqn": ("total_timesteps=30000", "evaluation.every=2000"),
    "ppo": ("total_timesteps=90000", "evaluation.every=10000"),
}
_TABLE = ("agent.gamma=0.95", "total_timesteps=20000", "agent.initial_value=1")
SOUND = {
    "q_learning": ("agent=q_learning", *_TABLE),
    "sarsa": ("agent=sarsa", *_TABLE),
    **{
        name: (f"agent={name}", "n_envs=128", *_LONG[name], *(f"agent.{key}={own[key]}" for key in own))
        for name, own in (("dqn", _DQN), ("ppo", _PPO))
    },
}


def _of_class(name: str, like: str) -> list[str]:
    """The sound settings of DQN or PPO for a class that is derived from it."""
    own = _PPO if like == "ppo" else _DQN
    given = ("learning_rate", "n_steps", "gamma", "ent_coef")  # of A2C, whose yaml has them
    return [
        *("agent=a2c", "agent.name=own", f"agent.algorithm={bugs.__name__}.{name}"),
        *("agent.log_interval=100", "n_envs=128", *_LONG[like]),
        *(f"~agent.arguments.{key}" for key in given if key not in own),
        *(f"{'' if key in given else '+'}agent.arguments.{key}={value}" for key, value in own.items()),
    ]


_ALWAYS = "agent.exploration_initial_eps=1 agent.exploration_final_eps=1 agent.initial_value=0"
_BUGS = (
    "WrongSign PPOBootstrapsTerminal PPORewardsShifted PPOGammaForgotten PPOActionsShifted PPOOnlyRewards "
    "PPOColumnsReversed PPOFrozenLayer PPOBlind NoTargetNetwork TargetNeverUpdated DQNBootstrapsTerminal "
    "ReplayOffByOne DQNRewardsShifted CostsLost DQNGammaForgotten EpsilonNeverFalls DQNFrozenLayer "
    "DQNDeadUnits MeanOfNext"
)
# fmt: off
_SETTINGS = {  # by agent: what was done, by which settings, the causes that name it
    "q_learning": [
        ("step too small", "agent.learning_rate=0.001", "slow"),
        ("step too large where chance decides", "agent.learning_rate=1 env.slip=0.3", "rate lost"),
        ("too few steps", f"{_ALWAYS} total_timesteps=200", "budget"),
        ("no look ahead", f"{_ALWAYS} agent.gamma=0", "objective"),
        ("first values too high", "agent.initial_value=1000", "slow"),
        ("first values too low",
         "agent.exploration_initial_eps=0.02 agent.exploration_final_eps=0.02 agent.initial_value=-100 "
         "total_timesteps=3000", "exploration budget"),
        ("exploration over at once",
         "agent.exploration_initial_eps=1 agent.exploration_final_eps=0 agent.initial_value=0 "
         "agent.exploration_fraction=0.01", "exploration"),
        ("short sight", "agent.gamma=0.5 env.slip=0.2", "objective"),
    ],
    "sarsa": [
        ("explores for ever",
         "agent.exploration_initial_eps=0.6 agent.exploration_final_eps=0.6 total_timesteps=60000",
         "epsilon"),
    ],
    "dqn": [
        ("rate too small", "agent.learning_rate=1e-6", "slow"),
        ("rate too large", "agent.learning_rate=1", "rate diverged"),
        ("target too old", "agent.target_update_interval=20000", "target"),
        ("network too narrow", "agent.policy_kwargs.net_arch=[1]", "network"),
        ("no exploration", "agent.exploration_initial_eps=0.01 agent.exploration_final_eps=0.01",
         "exploration"),
        ("exploration over at once", "agent.exploration_fraction=0.005 agent.exploration_final_eps=0",
         "exploration"),
        ("learning begins too late", "agent.learning_starts=29950", "slow"),
        ("horizon too short", "agent.gamma=0.1", "objective"),
        ("horizon too long", "agent.gamma=1", "objective"),
        ("too few updates", "agent.gradient_steps=1 agent.train_freq=32", "slow target"),
        ("buffer too small", "n_envs=8 agent.batch_size=16 agent.gradient_steps=8 agent.buffer_size=16",
         "forgetting lost"),
        ("too few steps", "total_timesteps=1000", "budget slow"),
    ],
    "ppo": [
        ("bonus too large", "agent.ent_coef=20", "entropy"),
        ("no bonus", "agent.ent_coef=0", "exploration"),
        ("rate too small", "agent.learning_rate=1e-7", "slow"),
        ("rate too large", "agent.learning_rate=1", "diverged rate"),
        ("horizon too short", "agent.gamma=0.1", "objective"),
        ("clipped to nothing", "agent.clip_range=1e-6", "slow"),
        ("network too narrow", "agent.policy_kwargs.net_arch=[1]", "network"),
        ("too few steps", "total_timesteps=4096", "budget slow"),
        ("gradient cut to nothing", "agent.max_grad_norm=1e-9", "slow"),
    ],
    "QuietDQN": [
        ("a sound class, rate too small", "agent.arguments.learning_rate=1e-6", "slow"),
        ("a sound class, target too old", "agent.arguments.target_update_interval=20000", "target"),
    ],
    **{name: [(getattr(bugs, name).__doc__.strip("."), "", "implementation")] for name in _BUGS.split()},
}
# fmt: on
CATALOGUE = [
    Sabotage(agent, name, tuple(words.split()), tuple(causes.split()))
    for agent, rows in _SETTINGS.items()
    for name, words, causes in rows
]
