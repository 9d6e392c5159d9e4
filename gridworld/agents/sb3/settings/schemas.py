"""Settings of the agents of Stable-Baselines3. Nothing here imports torch."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Optional

from gridworld.bounds import MOST_STEPS
from gridworld.config.agents import MOST_KEPT, REPLAY_COUNTS, AgentConfig, Schedule, WholeNumbers
from gridworld.config.fields import Arguments, ClassPath, Effect, Word, affects, bounds, rate

# OmegaConf reads these annotations at run time and knows no `X | None`.


# Arguments of SB3's classes that are a number to compute with: runs of one population may differ in them.
_NUMBERS = {
    *("learning_rate", "gamma", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm", "clip_range", "tau"),
    *("clip_range_vf", "target_kl", "exploration_fraction", "exploration_initial_eps", "name", "buffer_size"),
    *("exploration_final_eps", "learning_starts", "target_update_interval", "reward_scale", "log_interval"),
    "stats_window_size",
}
_COPIES, _NUMBER = 6, 4  # of each weight: its gradient, the optimiser's, a model file; bytes
_BYTES_OF_A_STEP = 64  # in a buffer, and while it is summed up
MOST_RETURN = 1e15  # of an episode: its square must be a number of 32 bits
_COUNT, _SHARE, _POSITIVE = bounds(1), bounds(0, 1), bounds(0, above=True)


@dataclass
class PolicyKwargs:
    """SB3's `policy_kwargs`; null or {} leaves SB3's own default. Classes are import paths, torch.nn.ReLU."""

    net_arch: WholeNumbers = None  # layer widths, [64, 64]
    activation_fn: Optional[ClassPath] = None  # noqa: UP045
    features_extractor_class: Optional[ClassPath] = None  # noqa: UP045
    features_extractor_kwargs: Arguments = field(default_factory=dict)
    normalize_images: Optional[bool] = None  # noqa: UP045
    optimizer_class: Optional[ClassPath] = None  # noqa: UP045
    optimizer_kwargs: Arguments = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.optimizer_kwargs = {
            name: value for name, value in self.optimizer_kwargs.items() if value is not None
        }


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


def counts_transitions(settings: Mapping[str, Any]) -> bool:
    """Whether an agent with these arguments keeps counts of transitions, not the transitions."""
    return settings.get("replay_buffer_class") == REPLAY_COUNTS


def as_dict(group: Any) -> dict[str, Any]:
    """The settings of a group, which is a dict or has a schema of its own."""
    return group if isinstance(group, dict) else vars(group)


@dataclass
class SB3Config(AgentConfig):
    """An algorithm with Stable-Baselines3's interface: `algorithm` is its class."""

    family: Word = "sb3"
    # of SB3's learn(): episodes for DQN, iterations for PPO
    log_interval: int = field(default=1, metadata=affects(Effect.LABELS) | bounds(1))
    policy: ClassPath = "MlpPolicy"
    # the network runs once per state, where there is such a version; stock: SB3's own loop, once per sample
    engine: Word = "tabulated"

    @property
    def libraries(self) -> tuple[str, ...]:
        return ("stable-baselines3", "sb3-contrib", "torch")

    @property
    def shape(self) -> str | None:
        # all that says how large arrays are, and what is done with them
        settings = asdict(self)
        settings |= settings.pop("arguments", {})
        if settings.get("engine") != "tabulated":
            return None
        return repr({key: value for key, value in settings.items() if key not in _NUMBERS})

    def memory(self, num_states: int, num_envs: int, total_timesteps: int) -> int:
        # its networks with their copies, and what it keeps of its steps
        settings = vars(self) | vars(self).get("arguments", {})
        nets = as_dict(settings.get("policy_kwargs") or {}).get("net_arch") or [64, 64]
        widths = [num_states, *(nets if isinstance(nets, list) else max(nets.values(), key=sum)), 1]
        weights = 2 * sum(above * below for above, below in itertools.pairwise(widths))
        kept = min(settings.get("buffer_size", settings.get("n_steps", 2048) * num_envs), total_timesteps)
        if counts_transitions(settings):
            kept = num_envs
        return int(_COPIES * _NUMBER * weights + _BYTES_OF_A_STEP * kept)


@dataclass
class SB3ClassConfig(SB3Config):
    """Any class of Stable-Baselines3, of sb3-contrib or of one's own, by its import path."""

    arguments: Arguments = field(  # of the class; it keeps its defaults
        default_factory=dict, metadata=affects(Effect.LEARNING, stats_window_size=Effect.LABELS)
    )

    @property
    def gamma(self) -> float:
        """The discount it learns with; 0.99 is the default of all of SB3's classes."""
        return float(self.arguments.get("gamma", 0.99))

    def key(self, name: str) -> str:
        return f"{'' if name in self.arguments else '+'}agent.arguments.{name}"


@dataclass
class SB3CheckedConfig(SB3Config):
    """A class of Stable-Baselines3 whose arguments are fields here, with their types."""

    # a number; lin_NUMBER, sqrt_NUMBER and quad_NUMBER fall to 0
    learning_rate: Schedule = field(default=1e-3, metadata=rate())
    batch_size: int = field(default=64, metadata=_COUNT)
    gamma: float = field(default=0.99, metadata=_SHARE)
    stats_window_size: int = field(default=100, metadata=affects(Effect.LABELS) | bounds(1, MOST_KEPT))
    policy_kwargs: PolicyKwargs = field(default_factory=PolicyKwargs)


@dataclass
class DQNConfig(SB3CheckedConfig):
    """Arguments of `stable_baselines3.DQN`, with its defaults."""

    name: Word = "dqn"
    algorithm: Word = "DQN"
    log_interval: int = 4
    learning_rate: Schedule = 1e-4
    batch_size: int = 32
    buffer_size: int = field(default=1_000_000, metadata=_COUNT)
    learning_starts: int = field(default=100, metadata=bounds(0))
    tau: float = field(default=1.0, metadata=_SHARE)
    train_freq: WholeNumbers = 4  # steps of the batch, or [n, step] or [n, episode]
    gradient_steps: int = field(default=1, metadata=bounds(-1))
    replay_buffer_class: Optional[ClassPath] = None  # noqa: UP045
    replay_buffer_kwargs: Arguments = field(default_factory=dict)
    # rewards are multiplied by it on their way to DQN; null: they are as they are
    reward_scale: Optional[float] = None  # noqa: UP045
    optimize_memory_usage: bool = False
    n_steps: int = field(default=1, metadata=bounds(1, MOST_STEPS))
    target_update_interval: int = field(default=10_000, metadata=_COUNT)
    exploration_fraction: float = field(default=0.1, metadata=bounds(0, 1, above=True))
    exploration_initial_eps: float = field(default=1.0, metadata=_SHARE)
    exploration_final_eps: float = field(default=0.05, metadata=_SHARE)
    max_grad_norm: float = field(default=10.0, metadata=_POSITIVE)


def reward_scale(config: AgentConfig) -> float:
    """By what an agent's rewards are multiplied; its values are the true ones times this."""
    given = getattr(config, "reward_scale", None)
    return 1.0 if given is None else float(given)


@dataclass
class PPOConfig(SB3CheckedConfig):
    """Arguments of `stable_baselines3.PPO`, with its defaults."""

    name: Word = "ppo"
    algorithm: Word = "PPO"
    policy_kwargs: ActorCriticPolicyKwargs = field(default_factory=ActorCriticPolicyKwargs)
    learning_rate: Schedule = 3e-4
    n_steps: int = field(default=2048, metadata=_COUNT)
    n_epochs: int = field(default=10, metadata=_COUNT)
    gae_lambda: Schedule = field(default=0.95, metadata=rate(1))
    clip_range: Schedule = field(default=0.2, metadata=rate(MOST_RETURN, linear_only=True))
    clip_range_vf: Optional[Schedule] = field(default=None, metadata=rate(MOST_RETURN, linear_only=True))  # noqa: UP045
    normalize_advantage: bool = True
    ent_coef: Schedule = field(default=0.0, metadata=rate())
    vf_coef: float = field(default=0.5, metadata=bounds(0))
    max_grad_norm: float = field(default=0.5, metadata=_POSITIVE)
    use_sde: bool = False
    sde_sample_freq: int = -1
    rollout_buffer_class: Optional[ClassPath] = None  # noqa: UP045
    rollout_buffer_kwargs: Arguments = field(default_factory=dict)
    target_kl: Optional[float] = field(default=None, metadata=_POSITIVE)  # noqa: UP045


SCHEMAS: dict[str, type[AgentConfig]] = {"dqn": DQNConfig, "ppo": PPOConfig, "sb3": SB3ClassConfig}
