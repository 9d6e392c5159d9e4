"""Settings of the agents of Stable-Baselines3, and their checks before training; without torch."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, is_dataclass
from typing import Any, Optional

from gridworld.bounds import MOST_STEPS, Bounds
from gridworld.config.fields import (
    BOUNDS,
    MOST_KEPT,
    Arguments,
    ClassPath,
    Decay,
    Effect,
    Schedule,
    WholeNumbers,
    Word,
    affects,
    bounds,
    declared,
    falls,
    parse_schedule,
    rate,
)
from gridworld.config.train import AgentConfig, ObservationConfig, TrainConfig
from gridworld.errors import InputError

# OmegaConf reads these annotations at run time and knows no `X | None`.

SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")  # what SB3 has a linear schedule for
FALLING = ("ent_coef", "gae_lambda", "learning_rate")  # see `agents.sb3.callbacks` for all other ones
REPLAY_COUNTS = "gridworld.agents.sb3.replay_counts.ReplayCounts"  # a replay buffer that counts transitions
# Arguments of SB3's classes that are a number to compute with: runs of one population may differ in them.
_NUMBERS = {
    *("learning_rate", "gamma", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm", "clip_range", "tau"),
    *("clip_range_vf", "target_kl", "exploration_fraction", "exploration_initial_eps", "name", "buffer_size"),
    *("exploration_final_eps", "learning_starts", "target_update_interval", "reward_scale", "log_interval"),
    "stats_window_size",
}
_COPIES, _NUMBER = 6, 4  # of each weight: its gradient, the optimiser's, a model file; bytes
_BYTES_OF_A_STEP = 64  # in a buffer, and while it is summed up
_MOST_RETURN = 1e15  # of an episode: its square must be a number of 32 bits
_LEAST_REWARD = 1e-30  # in networks' 32 bits
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
    def given(self) -> Mapping[str, Any]:
        """The arguments of its class, by their names."""
        return vars(self)

    @property
    def policy_kwargs_given(self) -> dict[str, Any]:
        """Its `policy_kwargs`; {} where there are none."""
        return as_dict(self.given.get("policy_kwargs") or {})

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
        settings = asdict(self)
        settings |= settings.pop("arguments", {})
        if settings.get("engine") != "tabulated":
            return None
        return repr({key: value for key, value in settings.items() if key not in _NUMBERS})

    def memory(self, num_states: int, num_envs: int, total_timesteps: int) -> int:
        # its networks with their copies, and what it keeps of its steps
        nets = self.policy_kwargs_given.get("net_arch") or [64, 64]
        widths = [num_states, *(nets if isinstance(nets, list) else max(nets.values(), key=sum)), 1]
        weights = 2 * sum(above * below for above, below in itertools.pairwise(widths))
        rollout = self.given.get("n_steps", 2048) * num_envs
        kept = min(self.given.get("buffer_size", rollout), total_timesteps)
        if self.counts_transitions:
            kept = num_envs
        return int(_COPIES * _NUMBER * weights + _BYTES_OF_A_STEP * kept)

    def falling(self) -> dict[str, Decay]:
        """Its settings that fall over training."""
        return {
            name: parse_schedule(name, self.given[name]) for name in FALLING if falls(self.given.get(name))
        }


@dataclass
class SB3ClassConfig(SB3Config):
    """Any class of Stable-Baselines3, of sb3-contrib or a custom one, by its import path."""

    arguments: Arguments = field(  # of the class; it keeps its defaults
        default_factory=dict, metadata=affects(Effect.LEARNING, stats_window_size=Effect.LABELS)
    )

    @property
    def given(self) -> Mapping[str, Any]:
        return self.arguments

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
    clip_range: Schedule = field(default=0.2, metadata=rate(_MOST_RETURN, linear_only=True))
    clip_range_vf: Optional[Schedule] = field(default=None, metadata=rate(_MOST_RETURN, linear_only=True))  # noqa: UP045
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
    """See `gridworld.agents.Family.check`: what SB3 would fail on later, or accept with another meaning."""
    agent = config.agent
    assert isinstance(agent, SB3Config)
    if agent.engine not in ("tabulated", "stock"):
        raise InputError(f"agent.engine={agent.engine}: must be tabulated or stock")
    for index, entry in enumerate(config.callbacks):
        path = entry.get("_target_") if isinstance(entry, dict) else None
        if not isinstance(path, str) or "." not in path:
            raise InputError(
                f"callbacks[{index}]={entry}: must be a mapping of _target_, the import path of a callback's "
                "class, and its arguments, e.g. {_target_: "
                "stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes, max_episodes: 500}"
            )
    _check_observation(agent, config.observation)
    # An episode's return and its square must be numbers of 32 bits.
    steps = config.env.max_episode_steps or 1
    for name, times in (("step_reward", steps), ("goal_reward", 1), ("trap_reward", 1)):
        most = _MOST_RETURN / times
        reward = vars(config.env).get(name, 0.0)
        Bounds(-most, most, least=_LEAST_REWARD).check(f"env.{name}", reward)
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


def _check_observation(agent: SB3Config, observation: ObservationConfig) -> None:
    given = agent.given.get("policy_kwargs", {})
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
    if agent.buffer_size < agent.batch_size and not agent.counts_transitions:
        raise InputError(
            f"agent.buffer_size={agent.buffer_size}: smaller than a batch; "
            f"must be at least agent.batch_size={agent.batch_size}"
        )
    if agent.counts_transitions and agent.n_steps > 1:
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
