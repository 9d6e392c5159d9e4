"""Settings of the agents of Stable-Baselines3, and their checks before training; without torch."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, Optional

from gridworld.base.bounds import MOST_STEPS, Bounds, Decay, Rate, falls, parse_schedule
from gridworld.base.errors import InputError
from gridworld.config.fields import (
    MOST_KEPT,
    Arguments,
    ClassPath,
    Effect,
    Schedule,
    WholeNumbers,
    Word,
    declared,
    setting,
)
from gridworld.config.train import AgentConfig, TrainConfig

# OmegaConf reads these annotations at run time and knows no `X | None`.

SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")  # what SB3 has a linear schedule for
FALLING = ("ent_coef", "gae_lambda", "learning_rate")  # see `agents.sb3.callbacks` for all other ones
REPLAY_COUNTS = "gridworld.agents.sb3.replay_counts.ReplayCounts"  # a replay buffer that counts transitions
# Arguments of SB3's classes that are a number to compute with: runs of one population may differ in them.
_NUMBERS = {
    *("learning_rate", "gamma", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm", "clip_range", "name"),
    *("clip_range_vf", "target_kl", "exploration_fraction", "exploration_initial_eps", "log_interval"),
    *("exploration_final_eps", "reward_scale", "stats_window_size", "line_search_shrinking_factor"),
}
# Fields that are ours, not arguments of the algorithm's class.
_OWN_FIELDS = {"name", "family", "algorithm", "engine", "log_interval", "reward_scale", "policy"}
_BYTES_OF_A_WEIGHT = 24  # with its gradient, the optimiser's numbers and a model file
_BYTES_OF_A_STEP = 64  # in a buffer, and while it is summed up
_CNN_FEATURES = 512  # of the last layer of SB3's NatureCNN
_MOST_RETURN = 1e15  # of an episode
_LEAST_REWARD = 1e-30  # in networks' 32 bits
_COUNT, _SHARE, _POSITIVE = Bounds(1), Bounds(0, 1), Bounds(0, above=True)


@dataclass
class PolicyKwargs:
    """SB3's `policy_kwargs`; null or {} leaves SB3's own default. Classes are import paths, torch.nn.ReLU."""

    net_arch: WholeNumbers = None  # layer widths, [64, 64]
    activation_fn: Optional[ClassPath] = None  # noqa: UP045
    features_extractor_class: Optional[ClassPath] = None  # noqa: UP045
    features_extractor_kwargs: Arguments = setting(dict)
    normalize_images: Optional[bool] = None  # noqa: UP045
    optimizer_class: Optional[ClassPath] = None  # noqa: UP045
    optimizer_kwargs: Arguments = setting(dict)

    def __post_init__(self) -> None:
        given = self.optimizer_kwargs
        self.optimizer_kwargs = {name: value for name, value in given.items() if value is not None}


@dataclass
class ActorCriticPolicyKwargs(PolicyKwargs):
    """The same for policies with a value network; net_arch may be {pi: [...], vf: [...]}."""

    ortho_init: Optional[bool] = None  # noqa: UP045
    use_sde: Optional[bool] = None  # noqa: UP045
    log_std_init: Optional[float] = None  # noqa: UP045
    full_std: Optional[bool] = None  # noqa: UP045
    use_expln: Optional[bool] = None  # noqa: UP045
    squash_output: Optional[bool] = None  # noqa: UP045
    share_features_extractor: Optional[bool] = None  # noqa: UP045


def _whole_numbers(node: Any) -> Iterator[int]:
    """Those in nested settings, in their order."""
    if isinstance(node, dict | list | tuple):
        for each in node.values() if isinstance(node, dict) else node:
            yield from _whole_numbers(each)
    elif type(node) is int and node > 0:
        yield node


@dataclass
class SB3Config(AgentConfig):
    """An algorithm with Stable-Baselines3's interface: `algorithm` is its class."""

    family: Word = "sb3"
    # of SB3's learn(): episodes for DQN, iterations for PPO
    log_interval: int = setting(1, Effect.LABELS, Bounds(1))
    policy: ClassPath = "MlpPolicy"
    # the network runs once per state, where there is such a version; stock: SB3's own loop, once per sample
    engine: Word = "tabulated"

    @property
    def libraries(self) -> tuple[str, ...]:
        return ("stable-baselines3", "sb3-contrib", "torch")

    @property
    def where(self) -> str:
        """The key of its class's arguments."""
        return "agent"

    @property
    def given(self) -> Mapping[str, Any]:
        """The arguments of its class, by their names."""
        return {name: value for name, value in vars(self).items() if name not in _OWN_FIELDS}

    @property
    def policy_kwargs_given(self) -> dict[str, Any]:
        """Its `policy_kwargs` that say something."""
        given = self.given.get("policy_kwargs") or {}
        found = vars(given) if is_dataclass(given) else given
        if not isinstance(found, dict):
            raise InputError(
                f"{self.where}.policy_kwargs={found}: must be a mapping, e.g. {{net_arch:[64,64]}}"
            )
        return {name: value for name, value in found.items() if value is not None and value != {}}

    @property
    def counts_transitions(self) -> bool:
        """Whether it keeps counts of transitions, not the transitions."""
        return self.given.get("replay_buffer_class") == REPLAY_COUNTS

    @property
    def reward_factor(self) -> float:
        """By what its rewards are multiplied; its values are the true ones times this."""
        scale = getattr(self, "reward_scale", None)
        return 1.0 if scale is None else float(scale)

    @property
    def shape(self) -> str | None:
        # all that says how large arrays are, and what is done with them
        if self.engine != "tabulated":
            return None
        settings = asdict(self)
        settings |= settings.pop("arguments", {})
        return repr({key: value for key, value in settings.items() if key not in _NUMBERS})

    def memory(self, num_states: int, num_envs: int, total_timesteps: int) -> int:
        # its networks with their copies, where any whole number may be a layer's width, and its steps
        widths = list(_whole_numbers(self.policy_kwargs_given)) or [64, 64]
        widths += [_CNN_FEATURES] if self.policy == "CnnPolicy" else []
        weights = 2 * (num_states + sum(widths)) * max(widths)
        rollout = self.given.get("n_steps", 2048) * num_envs
        kept = min(self.given.get("buffer_size", rollout), total_timesteps)
        return _BYTES_OF_A_WEIGHT * weights + _BYTES_OF_A_STEP * (
            num_envs if self.counts_transitions else kept
        )

    def falling(self) -> dict[str, Decay]:
        return {
            name: parse_schedule(name, self.given[name]) for name in FALLING if falls(self.given.get(name))
        }

    def check(self, run: TrainConfig) -> None:
        # What SB3 would fail on later, or accept with another meaning.
        super().check(run)
        if self.engine not in ("tabulated", "stock"):
            raise InputError(f"agent.engine={self.engine}: must be tabulated or stock")
        for index, entry in enumerate(run.callbacks):
            path = entry.get("_target_") if isinstance(entry, dict) else None
            if not isinstance(path, str) or not re.search("[.:]", path):
                raise InputError(
                    f"callbacks[{index}]={entry}: must be a mapping of _target_, the import path of a "
                    "callback's class, and its arguments"
                )
        ends = {f"rewards.{letter}": pay for letter, pay in getattr(run.env, "rewards", {}).items()}
        steps = {"step_reward": run.env.max_episode_steps or 1, "goal_reward": 1, "trap_reward": 1}
        steps |= dict.fromkeys(ends, 1)
        for name, times in steps.items():  # an episode's return and its square must be numbers of 32 bits
            most, reward = _MOST_RETURN / times, (vars(run.env) | ends).get(name, 0.0)
            Bounds(-most, most, least=_LEAST_REWARD).check(f"env.{name}", reward)
        key, value = self.key("train_freq"), self.given.get("train_freq", 1)
        count, unit = value if isinstance(value, list | tuple) and len(value) == 2 else (value, "step")
        if type(count) is not int or unit not in ("step", "episode"):
            raise InputError(f"{key}={value}: must be a whole number, or [N,step] or [N,episode]")
        Bounds(1, MOST_STEPS).check(key, count, value)
        if unit == "episode" and run.n_envs > 1:
            raise InputError(f"{key}={value}: SB3 counts episodes of a single environment only; set n_envs=1")

    def build(self, context: Any) -> Any:
        from gridworld.agents.sb3.agent import build

        return build(self, context)

    def import_libraries(self) -> None:
        # Nothing is computed, which would keep torch from forking.
        from gridworld.agents.sb3 import agent  # noqa: F401

    def on_processor(self, device: str) -> bool:
        from stable_baselines3.common.utils import get_device

        try:
            return get_device(device).type == "cpu"
        except RuntimeError:  # of names that `build` refuses
            return True

    def weights(self, path: Path, most: int) -> dict[str, Any]:
        from gridworld.agents.sb3.model_file import read_weights

        return read_weights(path, most)


@dataclass
class SB3ClassConfig(SB3Config):
    """Any class of Stable-Baselines3, of sb3-contrib or a custom one, by its import path."""

    known_by = "arguments"

    # of the class, which keeps its defaults
    arguments: Arguments = setting(dict, {"stats_window_size": Effect.LABELS})

    @property
    def where(self) -> str:
        return "agent.arguments"

    @property
    def given(self) -> Mapping[str, Any]:
        return self.arguments

    @property
    def gamma(self) -> float:
        """The discount it learns with; 0.99 is the default of all of SB3's classes."""
        return float(self.arguments.get("gamma", 0.99))

    def key(self, name: str) -> str:
        return f"{'' if name in self.arguments else '+'}agent.arguments.{name}"

    def check(self, run: TrainConfig) -> None:
        super().check(run)
        for name, value in self.arguments.items():
            key = f"agent.arguments.{name}"
            if name in ("policy", "env", "seed", "device"):
                raise InputError(f"{key}: is a setting of the run, not an argument of the class")
            if name in _BOUNDS and value is not None:
                _BOUNDS[name].check(key, value)


@dataclass
class SB3CheckedConfig(SB3Config):
    """A class of Stable-Baselines3 whose arguments are fields here, with their types."""

    # a number; lin_NUMBER, sqrt_NUMBER and quad_NUMBER fall to 0
    learning_rate: Schedule = setting(1e-3, Rate())
    batch_size: int = setting(64, _COUNT)
    gamma: float = setting(0.99, _SHARE)
    stats_window_size: int = setting(100, Effect.LABELS, Bounds(1, MOST_KEPT))
    policy_kwargs: PolicyKwargs = setting(PolicyKwargs)


@dataclass
class DQNConfig(SB3CheckedConfig):
    """Arguments of `stable_baselines3.DQN`, with its defaults."""

    known_by = "buffer_size"
    name: Word = "dqn"
    algorithm: Word = "DQN"
    log_interval: int = 4
    learning_rate: Schedule = 1e-4
    batch_size: int = 32
    buffer_size: int = setting(1_000_000, _COUNT)
    learning_starts: int = setting(100, Bounds(0))
    tau: float = setting(1.0, _SHARE)
    train_freq: WholeNumbers = 4  # steps of the batch, or [n, step] or [n, episode]
    gradient_steps: int = setting(1, Bounds(-1))
    replay_buffer_class: Optional[ClassPath] = None  # noqa: UP045
    replay_buffer_kwargs: Arguments = setting(dict)
    # rewards are multiplied by it on their way to DQN; null: they are as they are
    reward_scale: Optional[float] = None  # noqa: UP045
    optimize_memory_usage: bool = False
    n_steps: int = setting(1, Bounds(1, MOST_STEPS))
    target_update_interval: int = setting(10_000, _COUNT)
    exploration_fraction: float = setting(0.1, Bounds(0, 1, above=True))
    exploration_initial_eps: float = setting(1.0, _SHARE)
    exploration_final_eps: float = setting(0.05, _SHARE)
    max_grad_norm: float = setting(10.0, _POSITIVE)

    def check(self, run: TrainConfig) -> None:
        super().check(run)
        if self.counts_transitions and self.n_steps > 1:
            raise InputError(f"agent.n_steps={self.n_steps}: ReplayCounts counts single steps; must be 1")
        if self.learning_starts >= run.total_timesteps:
            raise InputError(
                f"agent.learning_starts={self.learning_starts}: nothing would be learned; "
                f"must be below total_timesteps={run.total_timesteps}"
            )


@dataclass
class PPOConfig(SB3CheckedConfig):
    """Arguments of `stable_baselines3.PPO`, with its defaults."""

    known_by = "n_epochs"
    name: Word = "ppo"
    algorithm: Word = "PPO"
    policy_kwargs: ActorCriticPolicyKwargs = setting(ActorCriticPolicyKwargs)
    learning_rate: Schedule = 3e-4
    n_steps: int = setting(2048, _COUNT)
    n_epochs: int = setting(10, _COUNT)
    gae_lambda: Schedule = setting(0.95, Rate(high=1))
    clip_range: Schedule = setting(0.2, Rate(high=_MOST_RETURN, linear_only=True))
    clip_range_vf: Optional[Schedule] = setting(None, Rate(high=_MOST_RETURN, linear_only=True))  # noqa: UP045
    normalize_advantage: bool = True
    ent_coef: Schedule = setting(0.0, Rate())
    vf_coef: float = setting(0.5, Bounds(0))
    max_grad_norm: float = setting(0.5, _POSITIVE)
    use_sde: bool = False
    sde_sample_freq: int = -1
    rollout_buffer_class: Optional[ClassPath] = None  # noqa: UP045
    rollout_buffer_kwargs: Arguments = setting(dict)
    target_kl: Optional[float] = setting(None, _POSITIVE)  # noqa: UP045

    def check(self, run: TrainConfig) -> None:
        super().check(run)
        if (rollout := self.n_steps * run.n_envs) % self.batch_size:
            raise InputError(
                f"agent.batch_size={self.batch_size}: must divide the rollout, "
                f"agent.n_steps={self.n_steps} x n_envs={run.n_envs} = {rollout} steps"
            )


SCHEMAS: dict[str, type[AgentConfig]] = {"dqn": DQNConfig, "ppo": PPOConfig, "sb3": SB3ClassConfig}

_BOUNDS: dict[str, Bounds] = {  # of numbers by their names in SB3 and sb3-contrib
    name: found[Bounds]
    for schema in (DQNConfig, PPOConfig)
    for name, found in declared(schema).items()
    if Bounds in found
}
