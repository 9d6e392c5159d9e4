"""Checks before training: settings that SB3 would fail on later, or accept with another meaning."""

from __future__ import annotations

import math
from dataclasses import is_dataclass
from typing import Any

from gridworld.agents.sb3.settings.schemas import (
    DQNConfig,
    PPOConfig,
    SB3CheckedConfig,
    SB3ClassConfig,
    SB3Config,
    as_dict,
    counts_transitions,
)
from gridworld.bounds import MOST_STEPS, above_zero, at_least, at_most, within, within_size
from gridworld.config.agents import MOST_KEPT, check_exploration, falls, parse_schedule
from gridworld.config.train import ObservationConfig, TrainConfig
from gridworld.config.worlds import EnvConfig, MapConfig
from gridworld.errors import InputError

# Arguments that count something, by the names that SB3 and sb3-contrib give them.
_COUNTS = (
    *("n_steps", "batch_size", "sub_sampling_factor", "n_epochs", "n_critic_updates", "cg_max_steps"),
    *("buffer_size", "target_update_interval", "stats_window_size", "n_quantiles"),
)
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")  # what SB3 has a linear schedule for
FALLING = ("ent_coef", "gae_lambda", "learning_rate")  # see `agents.sb3.falling_setting` for all other ones
_ORDINARY = 1e3  # a rate or a coefficient; beyond, numbers of 32 bits may come to their end
_LEAST_REWARD, _MOST_RETURN = 1e-30, 1e15
# Those that are a share or a probability.
_SHARES = {
    *("gamma", "gae_lambda", "tau"),
    *("exploration_fraction", "exploration_initial_eps", "exploration_final_eps"),
}
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
    """See `gridworld.agents.Family.check`."""
    agent = config.agent
    assert isinstance(agent, SB3Config)
    at_least("agent.log_interval", agent.log_interval, 1)
    if agent.engine not in ENGINES:
        raise InputError(f"agent.engine={agent.engine}: must be {' or '.join(ENGINES)}")
    for index, entry in enumerate(config.callbacks):
        _check_callback(f"callbacks[{index}]", entry)
    _check_observation(agent, config.observation)
    _check_rewards(config.env)
    if isinstance(agent, SB3ClassConfig):
        _check_class(agent, config.n_envs)
    elif isinstance(agent, SB3CheckedConfig):
        _check_fields(agent, config)


def _check_callback(where: str, entry: Any) -> None:
    """What can be checked without importing it; building the agent checks the rest."""
    path = entry.get("_target_") if isinstance(entry, dict) else None
    if not isinstance(path, str) or "." not in path or not all(map(str.isidentifier, path.split("."))):
        raise InputError(
            f"{where}={entry}: must be a mapping of _target_, the import path of a callback's class, and its "
            "arguments, e.g. {_target_: stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes, "
            "max_episodes: 500}"
        )


def _check_rewards(env: EnvConfig) -> None:
    """An episode's return and its square must be numbers of 32 bits."""
    if not isinstance(env, MapConfig):  # of others, only the compiled world tells
        return
    for name, times in (("step_reward", env.max_episode_steps or 1), ("goal_reward", 1), ("trap_reward", 1)):
        value, why = getattr(env, name), ", for networks calculate in 32 bits"
        if math.isfinite(value):  # or the world says so
            within_size(f"env.{name}", value, _LEAST_REWARD, _MOST_RETURN / times, why)


def _check_observation(agent: SB3Config, observation: ObservationConfig) -> None:
    given = (vars(agent) | vars(agent).get("arguments", {})).get("policy_kwargs", {})
    if not (isinstance(given, dict) or is_dataclass(given)):
        raise InputError(f"{agent.key('policy_kwargs')}={given}: must be settings, e.g. {{net_arch:[64,64]}}")
    kwargs = as_dict(given)
    extractor = kwargs.get("features_extractor_class") or observation.features
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


def _check_class(agent: SB3ClassConfig, n_envs: int) -> None:
    """What can be checked without importing the class; building the agent checks the rest."""
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
    for name in sorted(agent.arguments.keys() & _SHARES):
        given = value = agent.arguments[name]
        if name in FALLING and falls(given):
            value = parse_schedule(f"agent.arguments.{name}", given).initial
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
            raise InputError(f"agent.arguments.{name}={given}: must be from 0 to 1")


def _check_fields(agent: SB3CheckedConfig, config: TrainConfig) -> None:
    parse_schedule("agent.learning_rate", agent.learning_rate)
    if isinstance(agent, PPOConfig):
        at_least("agent.n_steps", agent.n_steps, 1)  # the minibatch may follow from it
    at_least("agent.batch_size", agent.batch_size, 1)
    within("agent.gamma", agent.gamma, 0, 1)
    within("agent.stats_window_size", agent.stats_window_size, 1, MOST_KEPT)
    if isinstance(agent, DQNConfig):
        _check_dqn(agent, config)
    elif isinstance(agent, PPOConfig):
        _check_ppo(agent, config)


def _check_dqn(agent: DQNConfig, config: TrainConfig) -> None:
    at_least("agent.buffer_size", agent.buffer_size, 1)
    if agent.buffer_size < agent.batch_size and not counts_transitions(vars(agent)):
        raise InputError(
            f"agent.buffer_size={agent.buffer_size}: smaller than a batch; "
            f"must be at least agent.batch_size={agent.batch_size}"
        )
    if counts_transitions(vars(agent)) and agent.n_steps > 1:
        raise InputError(
            f"agent.n_steps={agent.n_steps}: agent.replay_buffer_class={agent.replay_buffer_class} counts "
            "single steps; must be 1, or set agent.replay_buffer_class=null"
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
    within("agent.n_steps", agent.n_steps, 1, MOST_STEPS)
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
    at_most(key, count, MOST_STEPS)
    if unit == "episode" and n_envs > 1:
        raise InputError(
            f"{key}={value}: SB3 counts episodes with one environment only; "
            f"set n_envs=1 (it is {n_envs}) or count steps"
        )


def _check_ppo(agent: PPOConfig, config: TrainConfig) -> None:
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
            "must be at least 2 and divide the rollout, or set agent.normalize_advantage=false"
        )
    if parse_schedule("agent.gae_lambda", agent.gae_lambda).initial > 1:
        raise InputError(f"agent.gae_lambda={agent.gae_lambda}: must be from 0 to 1")
    for name in ("clip_range", "clip_range_vf"):
        value = getattr(agent, name)
        if value is not None:
            clip_range = parse_schedule(f"agent.{name}", value, linear_only=True)
            at_most(f"agent.{name}", clip_range.initial, _MOST_RETURN)
    parse_schedule("agent.ent_coef", agent.ent_coef)
    at_least("agent.vf_coef", agent.vf_coef, 0)
    above_zero("agent.max_grad_norm", agent.max_grad_norm)
    if agent.use_sde:
        raise InputError(
            "agent.use_sde=true: gSDE explores continuous actions; GridWorld's are four, set it to false"
        )
    if agent.target_kl is not None:
        above_zero("agent.target_kl", agent.target_kl)
