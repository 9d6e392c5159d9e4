"""Every setting of a training run, typed: the schema that the files in `conf/` fill in.

Plain dataclasses. Hydra merges the yaml files and the command line into them and refuses a misspelt key or
a wrong type by name; `check` refuses values that make no sense together. Nothing heavy is imported here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Optional, Union

from gridworld.errors import InputError

# OmegaConf reads these annotations at run time and knows no `X | None`.
Schedule = Union[int, float, str]  # noqa: UP007
MISSING = "???"  # OmegaConf's sign for what has to be given
MOST_ENVS = 2**17  # eight times the largest batch that any measurement here is faster with
MOST_THREADS = 1024
MOST_STEPS = 100_000  # of an episode; an evaluation goes through all of them
AUTO = "auto"  # checkpoints as often as they cost next to nothing
LINEAR = "lin_"  # lin_0.003: from 0.003 at the start, linearly, to 0 at the end, as RL Zoo writes it


@dataclass
class EnvConfig:
    """The world; the arguments of `GridWorldEnv`."""

    layout: str = "classic"
    num_rows: Optional[int] = None  # noqa: UP045
    num_cols: Optional[int] = None  # noqa: UP045
    slip: float = 0.0
    step_reward: float = 0.0
    goal_reward: float = 1.0
    trap_reward: float = -1.0
    max_episode_steps: int = 100


@dataclass
class ObservationConfig:
    """What the agent sees of a state."""

    kind: str = "one_hot"
    cell_size: int = 8  # pixels, for images


@dataclass
class EvaluationConfig:
    """The exact evaluation."""

    every: int = 1000  # environment steps
    gamma: float = 0.99  # discount of value and regret, whatever discount the agent learns with
    stop_after: Optional[int] = None  # noqa: UP045  # end training at this many certificates in a row


@dataclass
class LoggingConfig:
    """What is told while training."""

    tensorboard: bool = True
    policy_map_every: int = 5  # evaluations between two pictures of the policy; 0 for none
    progress: bool = True


@dataclass
class RecordingConfig:
    """Pictures in the run's folder; TensorBoard gets them too."""

    policy_map: bool = True  # policy.png, values and greedy actions
    q_error: bool = True  # q_error.png, how far the values are from the true ones
    visits: bool = True  # visits.png, where training has been
    learning: bool = True  # learning.gif, the policy over training
    frames: bool = True  # the final greedy policy's episode as numbered PNGs in frames/
    gif: bool = True  # that episode as episode.gif
    mp4: bool = False  # and as episode.mp4, which needs the extra `video`
    cell_size: Optional[int] = None  # noqa: UP045  # pixels of the episode's; null: 100, less on large maps
    fps: int = 4


@dataclass
class CheckpointConfig:
    """What it takes to go on after an interruption."""

    every: Optional[Union[int, str]] = "auto"  # noqa: UP007, UP045  # steps; auto: as it costs little; null: none


@dataclass
class AgentConfig:
    """What all agents share. `family` is the module in gridworld/agents that knows the algorithm."""

    name: str = MISSING
    family: str = MISSING
    algorithm: str = MISSING


@dataclass
class PolicyKwargs:
    """SB3's `policy_kwargs`; null or {} leaves SB3's own default. Classes are import paths, torch.nn.ReLU."""

    net_arch: Any = None  # layer widths, [64, 64]
    activation_fn: Optional[str] = None  # noqa: UP045
    features_extractor_class: Optional[str] = None  # noqa: UP045
    features_extractor_kwargs: dict[str, Any] = field(default_factory=dict)
    normalize_images: Optional[bool] = None  # noqa: UP045
    optimizer_class: Optional[str] = None  # noqa: UP045
    optimizer_kwargs: dict[str, Any] = field(default_factory=dict)


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


@dataclass
class SB3Config(AgentConfig):
    """An algorithm with Stable-Baselines3's interface: `algorithm` is its class."""

    family: str = "sb3"
    log_interval: int = 1  # of SB3's learn(): episodes for DQN, iterations for PPO
    policy: str = "MlpPolicy"


@dataclass
class SB3ClassConfig(SB3Config):
    """Any class of Stable-Baselines3, of sb3-contrib or of one's own, by its import path."""

    arguments: dict[str, Any] = field(default_factory=dict)  # of the class; it keeps its defaults

    @property
    def gamma(self) -> float:
        """The discount it learns with; 0.99 is the default of all of SB3's classes."""
        return float(self.arguments.get("gamma", 0.99))


@dataclass
class SB3CheckedConfig(SB3Config):
    """A class of Stable-Baselines3 whose arguments are fields here, with their types."""

    engine: str = "tabulated"  # the network runs once per state; stock: SB3's own loop, once per sample
    learning_rate: Schedule = 1e-3  # a number, or lin_NUMBER to fall linearly to 0 at the end of training
    batch_size: int = 64
    gamma: float = 0.99
    stats_window_size: int = 100
    policy_kwargs: PolicyKwargs = field(default_factory=PolicyKwargs)


@dataclass
class DQNConfig(SB3CheckedConfig):
    """Arguments of `stable_baselines3.DQN`, with its defaults."""

    name: str = "dqn"
    algorithm: str = "DQN"
    log_interval: int = 4
    learning_rate: Schedule = 1e-4
    batch_size: int = 32
    buffer_size: int = 1_000_000
    learning_starts: int = 100
    tau: float = 1.0
    train_freq: Any = 4  # steps of the batch, or [n, step] or [n, episode]
    gradient_steps: int = 1
    replay_buffer_class: Optional[str] = None  # noqa: UP045
    replay_buffer_kwargs: dict[str, Any] = field(default_factory=dict)
    optimize_memory_usage: bool = False
    n_steps: int = 1
    target_update_interval: int = 10_000
    exploration_fraction: float = 0.1
    exploration_initial_eps: float = 1.0
    exploration_final_eps: float = 0.05
    max_grad_norm: float = 10.0


@dataclass
class PPOConfig(SB3CheckedConfig):
    """Arguments of `stable_baselines3.PPO`, with its defaults."""

    name: str = "ppo"
    algorithm: str = "PPO"
    policy_kwargs: ActorCriticPolicyKwargs = field(default_factory=ActorCriticPolicyKwargs)
    learning_rate: Schedule = 3e-4
    n_steps: int = 2048
    n_epochs: int = 10
    gae_lambda: float = 0.95
    clip_range: Schedule = 0.2
    clip_range_vf: Optional[Schedule] = None  # noqa: UP045
    normalize_advantage: bool = True
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    use_sde: bool = False
    sde_sample_freq: int = -1
    rollout_buffer_class: Optional[str] = None  # noqa: UP045
    rollout_buffer_kwargs: dict[str, Any] = field(default_factory=dict)
    target_kl: Optional[float] = None  # noqa: UP045


@dataclass
class TabularConfig(AgentConfig):
    """An agent that keeps a table over the states."""

    family: str = "tabular"
    gamma: float = 0.99


@dataclass
class TabularControlConfig(TabularConfig):
    """Temporal-difference control. Where Stable-Baselines3 has the same setting, it has the same name."""

    learning_rate: Schedule = 0.1  # step size; a number, or lin_NUMBER to fall linearly to 0
    learning_rate_power: float = 0.0  # times (visits of the state and action) ** -power
    initial_value: float = 0.0  # of every action in every state that is no end
    exploration_fraction: float = 1.0  # of training, in which epsilon falls linearly
    exploration_initial_eps: float = 1.0
    exploration_final_eps: float = 0.05
    stats_window_size: int = 100  # episodes that the means in TensorBoard are taken over
    log_interval: int = 100  # episodes between two points there


@dataclass
class QLearningConfig(TabularControlConfig):
    """Watkins's Q-learning."""

    name: str = "q_learning"
    algorithm: str = "q_learning"


@dataclass
class SarsaConfig(TabularControlConfig):
    """SARSA."""

    name: str = "sarsa"
    algorithm: str = "sarsa"


@dataclass
class ExpectedSarsaConfig(TabularControlConfig):
    """Expected SARSA."""

    name: str = "expected_sarsa"
    algorithm: str = "expected_sarsa"


@dataclass
class ValueIterationConfig(TabularConfig):
    """The exact optimum under `gamma`; nothing is trained."""

    name: str = "value_iteration"
    algorithm: str = "value_iteration"


@dataclass
class TrainConfig:
    """One training run."""

    seed: int = 0
    total_timesteps: int = 20_000  # environment steps
    n_envs: int = 64
    device: str = "cpu"
    threads: int = 1  # of torch
    agent: AgentConfig = field(default_factory=AgentConfig)  # the chosen agent's own schema in its place
    env: EnvConfig = field(default_factory=EnvConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    logging: LoggingConfig = field(default_factory=LoggingConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)


@dataclass
class SweepConfig:
    """How `-m` runs its jobs; `hydra.sweeper` on the command line."""

    _target_: str = "hydra_plugins.gridworld_sweeper.GridWorldSweeper"
    retry_failed: bool = False  # run again what failed
    stop_at_first_failure: bool = False  # leave the rest for later
    extend: bool = False  # use the folder of a sweep that shares no job with this one
    max_jobs: int = 10_000  # more are taken for a slip


@dataclass
class JoblibConfig:
    """`hydra/launcher=joblib`: a sweep's jobs side by side on this machine; `hydra.launcher` there."""

    _target_: str = "hydra_plugins.gridworld_sweeper.JoblibLauncher"
    n_jobs: int = -1


@dataclass
class SlurmConfig:
    """`hydra/launcher=slurm`; all but the first two are submitit's, by its names."""

    _target_: str = "hydra_plugins.gridworld_sweeper.SlurmLauncher"
    jobs_per_task: int = 1
    array_parallelism: int = 256
    timeout_min: int = 60
    signal_delay_s: int = 60
    cpus_per_task: int = 1
    mem_gb: Optional[float] = None  # noqa: UP045
    partition: Optional[str] = None  # noqa: UP045
    account: Optional[str] = None  # noqa: UP045
    qos: Optional[str] = None  # noqa: UP045
    constraint: Optional[str] = None  # noqa: UP045
    setup: list[str] = field(default_factory=list)
    more: dict[str, Any] = field(default_factory=dict)


@dataclass
class RayConfig:
    """`hydra/launcher=ray`."""

    _target_: str = "hydra_plugins.gridworld_sweeper.RayLauncher"
    init: dict[str, Any] = field(default_factory=dict)
    remote: dict[str, Any] = field(default_factory=dict)


@dataclass
class DimensionConfig:
    """What a search may choose for one key: a range, or a list."""

    type: str = "???"  # float, int, categorical
    low: Optional[float] = None  # noqa: UP045
    high: Optional[float] = None  # noqa: UP045  # included
    log: bool = False  # even on a logarithmic scale
    step: Optional[float] = None  # noqa: UP045
    choices: Optional[list[Any]] = None  # noqa: UP045


@dataclass
class TuneConfig:
    """How `scripts/tune.py` searches; `tune` on the command line."""

    trials: int = 100
    seeds: int = 3  # a trial's: seed, seed + 1, ...
    finalists: int = 5  # trials that go on to more seeds, beside what the search began from
    final_seeds: int = 10  # the next ones, for the finalists
    confirm_seeds: int = 20  # the next ones, for the winner and for what the search began from
    study: Optional[str] = None  # noqa: UP045  # its name; null: of agent and world
    folder: Optional[str] = None  # noqa: UP045  # null: runs/STUDY
    storage: Optional[str] = None  # noqa: UP045  # any URL that Optuna takes; null: study.db in the folder
    workers: int = -1  # processes; -1 for one on each core
    timeout: Optional[float] = None  # noqa: UP045  # seconds; no trial begins after that
    sampler: str = "tpe"  # or random
    sampler_seed: int = 0
    pruner: str = "median"  # or hyperband, none
    evaluations: int = 50  # of a seed, at least, to tell apart who is certified sooner
    reports: int = 10  # looks of the pruner at a seed's curve
    stop_after: Optional[int] = 3  # noqa: UP045  # a trial's seed ends at this many certificates in a row
    heartbeat: int = 5  # seconds; a worker silent for three times as long has lost its trial
    space: dict[str, DimensionConfig] = field(default_factory=dict)  # conf/tune/*.yaml


@dataclass
class SearchConfig:
    """The root of conf/tune.yaml."""

    tune: TuneConfig = field(default_factory=TuneConfig)


AGENT_SCHEMAS: dict[str, type[AgentConfig]] = {
    "dqn": DQNConfig,
    "ppo": PPOConfig,
    "q_learning": QLearningConfig,
    "sarsa": SarsaConfig,
    "expected_sarsa": ExpectedSarsaConfig,
    "value_iteration": ValueIterationConfig,
    "sb3": SB3ClassConfig,
}


LAUNCHER_SCHEMAS: dict[str, type] = {"joblib": JoblibConfig, "slurm": SlurmConfig, "ray": RayConfig}


def check(config: TrainConfig) -> None:
    """Raise `InputError` for a value that no run could use. Maps and rewards check themselves when built."""
    at_least("seed", config.seed, 0)
    if config.seed >= 2**32:
        raise InputError(f"seed={config.seed}: must be below 2**32")
    at_least("total_timesteps", config.total_timesteps, 1)
    at_least("n_envs", config.n_envs, 1)
    at_most("n_envs", config.n_envs, MOST_ENVS)
    at_least("threads", config.threads, 1)
    at_most("threads", config.threads, MOST_THREADS)
    check_step_limit(config.env)
    at_least("observation.cell_size", config.observation.cell_size, 1)
    at_least("evaluation.every", config.evaluation.every, 1)
    within("evaluation.gamma", config.evaluation.gamma, 0, 1)
    if config.evaluation.stop_after is not None:
        at_least("evaluation.stop_after", config.evaluation.stop_after, 1)
    at_least("logging.policy_map_every", config.logging.policy_map_every, 0)
    if config.recording.cell_size is not None:
        at_least("recording.cell_size", config.recording.cell_size, 2)
    every = config.checkpoint.every
    if not (every is None or every == AUTO or (type(every) is int and every >= 1)):
        raise InputError(
            f"checkpoint.every={every}: must be a number of steps, {AUTO}, or null for no checkpoints"
        )
    within("recording.fps", config.recording.fps, 1, 100)


def check_step_limit(env: EnvConfig) -> None:
    """Raise `InputError` for one that cannot be, or that an exact evaluation would not come to the end of."""
    at_least("env.max_episode_steps", env.max_episode_steps, 1)
    at_most("env.max_episode_steps", env.max_episode_steps, MOST_STEPS)


def parse_schedule(key: str, value: Schedule) -> tuple[float, bool]:
    """A rate that is finite and not negative, and whether it falls linearly to 0. Raises `InputError`."""
    linear = isinstance(value, str) and value.startswith(LINEAR)
    try:
        number = float(value.removeprefix(LINEAR) if isinstance(value, str) and linear else value)
    except ValueError:
        number = math.nan
    if not 0 <= number < math.inf or (isinstance(value, str) and not linear):
        raise InputError(
            f"{key}={value}: must be a number of at least 0, or {LINEAR}NUMBER for a linear decay"
        )
    return number, linear


def check_exploration(agent: DQNConfig | TabularControlConfig) -> None:
    """Raise `InputError` unless epsilon goes from one probability to another within training."""
    above_zero("agent.exploration_fraction", agent.exploration_fraction)
    within("agent.exploration_fraction", agent.exploration_fraction, 0, 1)
    within("agent.exploration_initial_eps", agent.exploration_initial_eps, 0, 1)
    within("agent.exploration_final_eps", agent.exploration_final_eps, 0, 1)


def at_least(key: str, value: float, bound: float) -> None:
    """Refuse a value that is below the bound, infinite or NaN."""
    if not bound <= value < math.inf:
        raise InputError(f"{key}={value}: must be at least {bound}")


def at_most(key: str, value: float, bound: float) -> None:
    """Refuse a value that is above the bound, or NaN."""
    if not value <= bound:
        raise InputError(f"{key}={value}: must be at most {bound}")


def above_zero(key: str, value: float) -> None:
    """Refuse a value that is not positive, infinite or NaN."""
    if not 0 < value < math.inf:
        raise InputError(f"{key}={value}: must be a positive number")


def within(key: str, value: float, low: float, high: float) -> None:
    """Refuse a value outside [low, high], or NaN."""
    if not low <= value <= high:
        raise InputError(f"{key}={value}: must be from {low} to {high}")
