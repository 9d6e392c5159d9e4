"""Every setting of a training run, typed: the schema that the files in `conf/` fill in.

Plain dataclasses. Hydra merges the yaml files and the command line into them and refuses a misspelt key or
a wrong type by name; `check` refuses values that make no sense together. A field's metadata says what the
setting affects (`gridworld.config.effects`). Nothing heavy is imported here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Optional, Union

from gridworld.bounds import at_least, at_most, discount, within
from gridworld.config.agents import AgentConfig
from gridworld.config.effects import Effect, affects
from gridworld.config.pictures import RecordingConfig
from gridworld.config.privileges import privilege
from gridworld.config.texts import Callback, ClassPath, Word
from gridworld.config.worlds import EnvConfig, MapConfig
from gridworld.errors import InputError

# OmegaConf reads the annotations at run time and knows no `X | None`.

MOST_ENVS = 2**17  # eight times the largest batch that any measurement here is faster with
MOST_BONUS = 10**6  # of exploration; any reward beside it would be lost in the numbers of a network
MOST_THREADS = 1024
AUTO = "auto"  # checkpoints as often as they cost next to nothing


@dataclass
class ObservationConfig:
    """What the agent sees of a state."""

    kind: Word = "one_hot"  # or coordinates, image, own, none (the state's number)
    cell_size: int = 8  # pixels, for images
    # features extractor of an `MlpPolicy` whose settings name none; null: Stable-Baselines3's own
    features: Optional[ClassPath] = None  # noqa: UP045

    def policy_kwargs(self) -> dict[str, Any]:
        """What this adds to an `MlpPolicy`'s settings: its features extractor, with an image's cell size."""
        if self.features is None:
            return {}
        own = {"cell_size": self.cell_size} if self.kind == "image" else {}
        return {"features_extractor_class": self.features, "features_extractor_kwargs": own}


@dataclass
class EvaluationConfig:
    """The exact evaluation."""

    every: int = 1000  # environment steps
    # discount of value and regret, whatever discount the agent learns with
    gamma: float = field(default=0.99, metadata=affects(Effect.TASK))
    stop_after: Optional[int] = None  # noqa: UP045  # end training at this many certificates in a row


@dataclass
class LoggingConfig:
    """What is logged while training."""

    tensorboard: bool = True  # write an event file
    policy_map_every: int = 5  # evaluations between two pictures of the policy; 0 for none
    progress: bool = field(default=True, metadata=affects(Effect.NOTHING))


@dataclass
class CheckpointConfig:
    """What it takes to go on after an interruption."""

    every: Optional[Union[int, Word]] = "auto"  # noqa: UP007, UP045  # steps; auto: as it costs little; null: none


@dataclass
class TrainConfig:
    """One training run."""

    # the tuned settings of the agent in the world, a file in conf/tuned, that went into this; null: none
    recipe: Optional[Word] = field(default=None, metadata=affects(Effect.NOTHING))  # noqa: UP045
    # of conf/preset, whose numbers went into this; auto: none was needed (`config.composition.presets`)
    preset: Word = field(default="none", metadata=affects(Effect.NOTHING))
    # what came of these settings when they were tried, where they do not solve the task
    known_failure: Optional[Word] = field(default=None, metadata=affects(Effect.NOTHING))  # noqa: UP045
    seed: int = field(default=0, metadata=affects(Effect.SEED))  # of all random numbers
    total_timesteps: int = field(default=20_000, metadata=affects(Effect.LENGTH))  # environment steps
    n_envs: int = 64  # environments that step together
    # b of b / sqrt(N), added to a reward of training for an action that was taken there N times; 0 for none
    exploration_bonus: float = 0.0
    # share of training episodes that begin in a state drawn uniformly
    exploring_starts: float = field(default=0.0, metadata=privilege("starts anywhere"))
    # whether environments in one state share out an action's outcomes evenly, see `gridworld.envs.vector_env`
    stratified_draws: bool = field(default=False, metadata=privilege("stratified draws"))
    device: Word = field(default="cpu", metadata=affects(Effect.MACHINE))
    threads: int = field(default=1, metadata=affects(Effect.MACHINE))  # of torch
    # of SB3: each a mapping of `_target_`, the import path of a class, and its arguments
    callbacks: list[Callback] = field(default_factory=list)
    agent: AgentConfig = field(default_factory=AgentConfig)  # the chosen agent's own schema in its place
    # of the chosen source (`gridworld.config.worlds`)
    env: EnvConfig = field(default_factory=MapConfig, metadata=affects(Effect.TASK))
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    evaluation: EvaluationConfig = field(
        default_factory=EvaluationConfig, metadata=affects(Effect.EVALUATION)
    )
    logging: LoggingConfig = field(default_factory=LoggingConfig, metadata=affects(Effect.FILES))
    recording: RecordingConfig = field(default_factory=RecordingConfig, metadata=affects(Effect.FILES))
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig, metadata=affects(Effect.NOTHING))


def check(config: TrainConfig) -> None:
    """Check the values that no schema can. Maps, rewards and agents are checked elsewhere."""
    at_least("seed", config.seed, 0)
    if config.seed >= 2**32:
        raise InputError(f"seed={config.seed}: must be below 2**32")
    at_least("total_timesteps", config.total_timesteps, 1)
    at_least("n_envs", config.n_envs, 1)
    at_most("n_envs", config.n_envs, MOST_ENVS)
    within("exploration_bonus", config.exploration_bonus, 0, MOST_BONUS)
    within("exploring_starts", config.exploring_starts, 0, 1)
    at_least("threads", config.threads, 1)
    at_most("threads", config.threads, MOST_THREADS)
    config.env.check()
    at_least("observation.cell_size", config.observation.cell_size, 1)
    at_least("evaluation.every", config.evaluation.every, 1)
    discount("evaluation.gamma", config.evaluation.gamma)
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
