"""Checks before training: settings that SB3 would fail on later, or accept with another meaning."""

from __future__ import annotations

from dataclasses import is_dataclass
from typing import Any

from gridworld.agents.sb3.settings.schemas import (
    MOST_RETURN,
    DQNConfig,
    PPOConfig,
    SB3ClassConfig,
    SB3Config,
    as_dict,
    counts_transitions,
)
from gridworld.bounds import MOST_STEPS, Bounds
from gridworld.config.agents import falls, parse_schedule
from gridworld.config.fields import BOUNDS, declared
from gridworld.config.train import ObservationConfig, TrainConfig
from gridworld.config.worlds import EnvConfig
from gridworld.errors import InputError

SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")  # what SB3 has a linear schedule for
FALLING = ("ent_coef", "gae_lambda", "learning_rate")  # see `agents.sb3.callbacks` for all other ones
ENGINES = ("tabulated", "stock")
_LEAST_REWARD = 1e-30  # in networks' 32 bits
# By their names in SB3 and sb3-contrib: counts that neither DQN nor PPO has, and what these two have.
_BOUNDS: dict[str, Bounds] = dict.fromkeys(
    ("sub_sampling_factor", "n_critic_updates", "cg_max_steps", "n_quantiles"), Bounds(1)
) | {
    name: metadata[BOUNDS]
    for schema in (DQNConfig, PPOConfig)
    for name, metadata in declared(schema).items()
    if BOUNDS in metadata
}
# Arguments of an SB3 class that are settings of the run, and where they are set.
_ELSEWHERE = {
    "policy": "agent.policy",
    "env": "env",
    "seed": "seed",
    "device": "device",
    "tensorboard_log": "logging.tensorboard",
    "verbose": "logging.progress",
}


def check(config: TrainConfig) -> None:
    """See `gridworld.agents.Family.check`."""
    agent = config.agent
    assert isinstance(agent, SB3Config)
    if agent.engine not in ENGINES:
        raise InputError(f"agent.engine={agent.engine}: must be {' or '.join(ENGINES)}")
    for index, entry in enumerate(config.callbacks):
        path = entry.get("_target_") if isinstance(entry, dict) else None
        if not isinstance(path, str) or "." not in path:
            raise InputError(
                f"callbacks[{index}]={entry}: must be a mapping of _target_, the import path of a callback's "
                "class, and its arguments, e.g. {_target_: "
                "stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes, max_episodes: 500}"
            )
    _check_observation(agent, config.observation)
    _check_rewards(config.env)
    if isinstance(agent, SB3ClassConfig):
        for name in _ELSEWHERE.keys() & agent.arguments.keys():
            raise InputError(f"agent.arguments.{name}: is not set here but by {_ELSEWHERE[name]}=...")
        _check_numbers("agent.arguments", agent.arguments)
        if "train_freq" in agent.arguments:
            _check_train_freq("agent.arguments.train_freq", agent.arguments["train_freq"], config.n_envs)
    elif isinstance(agent, DQNConfig):
        _check_dqn(agent, config)
    elif isinstance(agent, PPOConfig):
        _check_ppo(agent, config.n_envs)


def _check_rewards(env: EnvConfig) -> None:
    """An episode's return and its square must be numbers of 32 bits; the compiled world checks the others."""
    for name, times in (("step_reward", env.max_episode_steps or 1), ("goal_reward", 1), ("trap_reward", 1)):
        most = MOST_RETURN / times
        Bounds(-most, most, least=_LEAST_REWARD).check(f"env.{name}", vars(env).get(name, 0.0))


def _check_observation(agent: SB3Config, observation: ObservationConfig) -> None:
    given = (vars(agent) | vars(agent).get("arguments", {})).get("policy_kwargs", {})
    if not (isinstance(given, dict) or is_dataclass(given)):
        raise InputError(f"{agent.key('policy_kwargs')}={given}: must be settings, e.g. {{net_arch:[64,64]}}")
    extractor = as_dict(given).get("features_extractor_class") or observation.features
    if observation.kind == "image" and agent.policy == "MlpPolicy" and extractor is None:
        raise InputError(
            "observation=image: agent.policy=MlpPolicy cannot see images without observation.features; leave "
            "that out, or set agent.policy=CnnPolicy"
        )
    if observation.kind != "image" and agent.policy == "CnnPolicy":
        raise InputError(
            f"observation={observation.kind}: agent.policy=CnnPolicy sees images only; "
            "set observation=image or agent.policy=MlpPolicy"
        )


def _check_numbers(where: str, content: dict[str, Any]) -> None:
    """What no algorithm can use, however its class is written."""
    for name, value in content.items():
        key, number = f"{where}.{name}", value
        if isinstance(value, dict):
            _check_numbers(key, value)
        if name in FALLING and falls(value):
            number = parse_schedule(key, value).initial
        if isinstance(number, int | float) and not isinstance(number, bool):
            _BOUNDS.get(name, Bounds()).check(key, number, value)


def _check_train_freq(key: str, value: Any, n_envs: int) -> None:
    count, unit = value if isinstance(value, list | tuple) and len(value) == 2 else (value, "step")
    if type(count) is not int or count < 1 or unit not in ("step", "episode"):
        raise InputError(f"{key}={value}: must be a whole number of at least 1, or [N,step] or [N,episode]")
    Bounds(1, MOST_STEPS).check(key, count, value)
    if unit == "episode" and n_envs > 1:
        raise InputError(
            f"{key}={value}: SB3 counts episodes with one environment only; "
            f"set n_envs=1 (it is {n_envs}) or count steps"
        )


def _check_dqn(agent: DQNConfig, config: TrainConfig) -> None:
    counts = counts_transitions(vars(agent))
    if agent.buffer_size < agent.batch_size and not counts:
        raise InputError(
            f"agent.buffer_size={agent.buffer_size}: smaller than a batch; "
            f"must be at least agent.batch_size={agent.batch_size}"
        )
    if counts and agent.n_steps > 1:
        raise InputError(
            f"agent.n_steps={agent.n_steps}: agent.replay_buffer_class={agent.replay_buffer_class} counts "
            "single steps; must be 1, or set agent.replay_buffer_class=null"
        )
    if agent.learning_starts >= config.total_timesteps:
        raise InputError(
            f"agent.learning_starts={agent.learning_starts}: nothing would be learned; "
            f"must be below total_timesteps={config.total_timesteps}"
        )
    if isinstance(agent.policy_kwargs.net_arch, dict):
        raise InputError(
            "agent.policy_kwargs.net_arch: DQN has one network; must be layer widths, e.g. [64,64]"
        )
    _check_train_freq("agent.train_freq", agent.train_freq, config.n_envs)


def _check_ppo(agent: PPOConfig, n_envs: int) -> None:
    rollout = agent.n_steps * n_envs
    if rollout % agent.batch_size:
        raise InputError(
            f"agent.batch_size={agent.batch_size}: must divide the rollout, "
            f"agent.n_steps={agent.n_steps} x n_envs={n_envs} = {rollout} steps"
        )
    if agent.normalize_advantage and agent.batch_size < 2:
        raise InputError(
            "agent.batch_size=1: an advantage cannot be normalised alone; "
            "must be at least 2 and divide the rollout, or set agent.normalize_advantage=false"
        )
    if agent.use_sde:
        raise InputError(
            "agent.use_sde=true: gSDE explores continuous actions; GridWorld's are four, set it to false"
        )
