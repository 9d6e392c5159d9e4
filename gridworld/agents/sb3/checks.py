"""Settings that SB3 would trip over later, or accept and mean something else, refused before training."""

from __future__ import annotations

import math
from typing import Any

from gridworld.agent_config import (
    DQNConfig,
    PPOConfig,
    SB3CheckedConfig,
    SB3ClassConfig,
    SB3Config,
    check_exploration,
    parse_schedule,
)
from gridworld.bounds import above_zero, at_least, within
from gridworld.config import TrainConfig
from gridworld.errors import InputError

# Arguments that count something, by the names that SB3 and sb3-contrib give them.
_COUNTS = (
    *("n_steps", "batch_size", "sub_sampling_factor", "n_epochs", "n_critic_updates", "cg_max_steps"),
    *("buffer_size", "target_update_interval", "stats_window_size", "n_quantiles"),
)
ENGINES = ("tabulated", "stock")

# Arguments of an SB3 class that are settings of the run, and where they stand.
_ELSEWHERE = {
    "policy": "agent.policy",
    "env": "env",
    "seed": "seed",
    "device": "device",
    "tensorboard_log": "logging.tensorboard",
    "verbose": "logging.progress",
}


def check(config: TrainConfig) -> None:
    """Raise `InputError` for the first setting that could not train as it says."""
    agent = config.agent
    assert isinstance(agent, SB3Config)
    at_least("agent.log_interval", agent.log_interval, 1)
    _check_observation(agent, config.observation.kind)
    if isinstance(agent, SB3ClassConfig):
        _check_class(agent, config.n_envs)
    elif isinstance(agent, SB3CheckedConfig):
        _check_fields(agent, config)


def _check_observation(agent: SB3Config, kind: str) -> None:
    if kind == "image" and agent.policy == "MlpPolicy":
        raise InputError(
            "observation=image: agent.policy=MlpPolicy cannot see images; set agent.policy=CnnPolicy"
        )
    if kind != "image" and agent.policy == "CnnPolicy":
        raise InputError(
            f"observation={kind}: agent.policy=CnnPolicy sees images only; "
            "set observation=image or agent.policy=MlpPolicy"
        )


def _check_class(agent: SB3ClassConfig, n_envs: int) -> None:
    """What can be told without importing it; building the agent tells the rest."""
    if "." not in agent.algorithm or not all(part.isidentifier() for part in agent.algorithm.split(".")):
        raise InputError(
            f"agent.algorithm={agent.algorithm}: must be the import path of a class, "
            "e.g. stable_baselines3.A2C"
        )
    for name, place in _ELSEWHERE.items():
        if name in agent.arguments:
            raise InputError(f"agent.arguments.{name}: is not set here but by {place}=...")
    _check_numbers("agent.arguments", agent.arguments)
    if "train_freq" in agent.arguments:
        _check_train_freq("agent.arguments.train_freq", agent.arguments["train_freq"], n_envs)
    gamma = agent.arguments.get("gamma", 0.99)
    if isinstance(gamma, bool) or not isinstance(gamma, int | float) or not 0 <= gamma <= 1:
        raise InputError(f"agent.arguments.gamma={gamma}: must be from 0 to 1")


def _check_fields(agent: SB3CheckedConfig, config: TrainConfig) -> None:
    if agent.engine not in ENGINES:
        raise InputError(f"agent.engine={agent.engine}: must be {' or '.join(ENGINES)}")
    parse_schedule("agent.learning_rate", agent.learning_rate)
    at_least("agent.batch_size", agent.batch_size, 1)
    within("agent.gamma", agent.gamma, 0, 1)
    at_least("agent.stats_window_size", agent.stats_window_size, 1)
    if isinstance(agent, DQNConfig):
        _check_dqn(agent, config)
    elif isinstance(agent, PPOConfig):
        _check_ppo(agent, config)


def _check_dqn(agent: DQNConfig, config: TrainConfig) -> None:
    at_least("agent.buffer_size", agent.buffer_size, 1)
    if agent.buffer_size < agent.batch_size:
        raise InputError(
            f"agent.buffer_size={agent.buffer_size}: smaller than a batch; "
            f"must be at least agent.batch_size={agent.batch_size}"
        )
    at_least("agent.learning_starts", agent.learning_starts, 0)
    if agent.learning_starts >= config.total_timesteps:
        raise InputError(
            f"agent.learning_starts={agent.learning_starts}: nothing would be learned; "
            f"must be below total_timesteps={config.total_timesteps}"
        )
    if isinstance(agent.policy_kwargs.net_arch, dict):
        raise InputError(
            "agent.policy_kwargs.net_arch: DQN has one network; must be layer widths, e.g. [64,64]"
        )
    within("agent.tau", agent.tau, 0, 1)
    _check_train_freq("agent.train_freq", agent.train_freq, config.n_envs)
    at_least("agent.gradient_steps", agent.gradient_steps, -1)
    at_least("agent.n_steps", agent.n_steps, 1)
    at_least("agent.target_update_interval", agent.target_update_interval, 1)
    check_exploration(agent)
    above_zero("agent.max_grad_norm", agent.max_grad_norm)


def _check_numbers(where: str, content: dict[str, Any]) -> None:
    """What no algorithm can use, however its class is written: counts below 1, numbers that are none."""
    for name, value in content.items():
        if isinstance(value, dict):
            _check_numbers(f"{where}.{name}", value)
        elif isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{where}.{name}={value}: must be a finite number")
        elif name in _COUNTS and isinstance(value, int):
            at_least(f"{where}.{name}", value, 1)


def _check_train_freq(key: str, value: Any, n_envs: int) -> None:
    count, unit = value if isinstance(value, list | tuple) and len(value) == 2 else (value, "step")
    if isinstance(count, bool) or not isinstance(count, int) or count < 1 or unit not in ("step", "episode"):
        raise InputError(f"{key}={value}: must be a whole number of at least 1, or [N,step] or [N,episode]")
    if unit == "episode" and n_envs > 1:
        raise InputError(
            f"{key}={value}: SB3 counts episodes with one environment only; "
            f"set n_envs=1 (it is {n_envs}) or count steps"
        )


def _check_ppo(agent: PPOConfig, config: TrainConfig) -> None:
    at_least("agent.n_steps", agent.n_steps, 1)
    at_least("agent.n_epochs", agent.n_epochs, 1)
    rollout = agent.n_steps * config.n_envs
    if rollout % agent.batch_size:
        raise InputError(
            f"agent.batch_size={agent.batch_size}: must divide the rollout, "
            f"agent.n_steps={agent.n_steps} x n_envs={config.n_envs} = {rollout} steps"
        )
    if agent.normalize_advantage and agent.batch_size < 2:
        raise InputError(
            "agent.batch_size=1: an advantage cannot be normalised alone; "
            "must be at least 2, or set agent.normalize_advantage=false"
        )
    within("agent.gae_lambda", agent.gae_lambda, 0, 1)
    parse_schedule("agent.clip_range", agent.clip_range)
    if agent.clip_range_vf is not None:
        parse_schedule("agent.clip_range_vf", agent.clip_range_vf)
    at_least("agent.ent_coef", agent.ent_coef, 0)
    at_least("agent.vf_coef", agent.vf_coef, 0)
    above_zero("agent.max_grad_norm", agent.max_grad_norm)
    if agent.use_sde:
        raise InputError(
            "agent.use_sde=true: gSDE explores continuous actions; GridWorld's are four, set it to false"
        )
    if agent.target_kl is not None:
        above_zero("agent.target_kl", agent.target_kl)
