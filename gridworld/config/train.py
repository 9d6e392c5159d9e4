"""Every setting of a training run, typed: the schema that the files in `conf/` fill in.

Hydra refuses a misspelt key or a wrong type, `check` numbers outside of the bounds that their fields declare
(`gridworld.config.fields`). Nothing heavy is imported here. To add a picture, add a field to
`RecordingConfig` and a function to `gridworld.visualization` (see `gridworld.visualization.picture`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

from gridworld.base.bounds import LARGEST_INTEGER, MOST_ENVS, Bounds, Discount
from gridworld.base.errors import InputError
from gridworld.config.fields import (
    MISSING,
    Callback,
    ClassPath,
    Contact,
    Effect,
    Privilege,
    Word,
    declared,
    setting,
)
from gridworld.config.worlds import SOURCES, EnvConfig, MapConfig

MOST_BONUS = 10**6  # of exploration; any reward beside it would be lost in the numbers of a network
MOST_THREADS = 1024
AUTO = "auto"  # checkpoints as often as they cost next to nothing


@dataclass
class AgentConfig:
    """The settings of any agent, by which it is checked and built; a family of agents derives its schemas.

    They are in its package in `gridworld.agents`, and are read without what an agent needs to learn.
    """

    name: Word = setting(MISSING, Effect.LABELS)  # in tables and folders
    family: Word = MISSING  # the package in `gridworld.agents`
    algorithm: ClassPath = MISSING  # the class, by its import path where it is none of ours
    known_by = ""  # a setting that only its classes have; "": `algorithm` can be no class derived from it

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions whose versions its results depend on, besides those that every run depends on."""
        return ()

    @property
    def shape(self) -> str | None:
        """What must be equal for runs of it to train as one population; None: each trains by itself."""
        return None

    def key(self, name: str) -> str:
        """What the command line calls one of the algorithm's settings, which may not be given yet."""
        return f"agent.{name}"

    def memory(self, num_states: int, num_envs: int, total_timesteps: int) -> int:
        """About the bytes that a run of it takes while it trains, the larger part at least."""
        return 0

    def check(self, run: TrainConfig) -> None:
        """Check a run's settings; InputError: the first one that could not train as it says."""
        for key in ("family", "algorithm"):
            given, own = getattr(self, key), getattr(type(self), key)
            is_derived = self.known_by and key == "algorithm" and re.search("[.:]", given)
            if own not in (given, MISSING) and not is_derived:
                raise InputError(f"agent.{key}={given}: these settings are {own}'s; choose agent=...")

    def build(self, context: Any) -> Any:
        """Build an `Agent` in a `TrainingContext`; InputError: a setting that only its library can judge."""
        raise NotImplementedError

    def import_libraries(self) -> None:
        """Import what training takes; settings that cannot work are left for the run to refuse."""

    def on_processor(self, device: str) -> bool:
        """Whether a run with this `device` computes on the processor, not on a GPU."""
        return True

    def weights(self, path: Path, most: int) -> dict[str, Any]:
        """The arrays of a model file by name; InputError: it has more than `most` bytes, or is damaged."""
        raise NotImplementedError


@dataclass
class ObservationConfig:
    """What the agent sees of a state."""

    kind: Word = "one_hot"  # or coordinates, image, own, none (the state's number)
    cell_size: int = setting(8, Bounds(1))  # pixels, for images
    # features extractor of an `MlpPolicy` whose settings name none; null: Stable-Baselines3's own
    features: ClassPath | None = None

    def policy_kwargs(self) -> dict[str, Any]:
        """What this adds to an `MlpPolicy`'s settings: its features extractor, with an image's cell size."""
        if self.features is None:
            return {}
        own = {"cell_size": self.cell_size} if self.kind == "image" else {}
        return {"features_extractor_class": self.features, "features_extractor_kwargs": own}


@dataclass
class EvaluationConfig:
    """The exact evaluation; what each setting is, here and below, is in conf/train.yaml."""

    every: int = setting(1000, Bounds(1))
    gamma: float = setting(0.99, Effect.TASK, Discount())
    stop_after: int | None = setting(None, Bounds(1))


@dataclass
class LoggingConfig:
    """What is logged while training."""

    tensorboard: bool = True  # write an event file
    policy_map_every: int = setting(5, Bounds(0))
    progress: bool = setting(True, Effect.NOTHING)
    wandb: Contact = setting(False, Effect.NOTHING)


@dataclass(frozen=True)
class Picture:
    """A file, or a folder of numbered PNGs, that is drawn when training is over."""

    file: str  # in the run's folder; its ending says what it is written as
    drawer: str  # "module.function" in `gridworld.visualization`, which draws it
    caption: str | None = None  # in a report's page; None: it has no place there
    while_training: bool = False  # TensorBoard has it every `logging.policy_map_every` evaluations

    @property
    def name(self) -> str:
        """What `record.py --format` and TensorBoard call it."""
        return Path(self.file).stem

    @property
    def is_map(self) -> bool:
        """Whether it is a still picture of the whole world."""
        return self.file.endswith(".png")


@dataclass
class RecordingConfig:
    """Pictures in the run's folder; TensorBoard gets them too."""

    policy_map: bool = setting(True, Picture("policy.png", "maps.policy", "policy", while_training=True))
    q_error: bool = setting(True, Picture("q_error.png", "maps.q_error", "error of its values"))
    visits: bool = setting(True, Picture("visits.png", "maps.visits", "visits while it learned"))
    learning: bool = setting(True, Picture("learning.gif", "maps.learning", "policy while it learned"))
    frames: bool = setting(True, Picture("frames", "episode.episode"))
    gif: bool = setting(True, Picture("episode.gif", "episode.episode"))
    mp4: bool = setting(False, Picture("episode.mp4", "episode.episode"))
    cell_size: int | None = setting(None, Bounds(2))
    fps: int = setting(4, Bounds(1, 100))  # frames a second


# By the names of their settings.
PICTURES = {name: found[Picture] for name, found in declared(RecordingConfig).items() if Picture in found}


@dataclass
class CheckpointConfig:
    """What it takes to go on after an interruption."""

    every: int | Word | None = AUTO


@dataclass
class TrainConfig:
    """One training run."""

    # the agent, or its recipe that went into this: AGENT/NAME, a file in conf/tuned (`config.recipes`)
    recipe: Word | None = setting(None, Effect.NOTHING)
    # what came of these settings when they were tried, where they do not solve the task
    known_failure: Word | None = setting(None, Effect.NOTHING)
    seed: int = setting(0, Effect.SEED, Bounds(0, 2**32 - 1))  # of all random numbers
    total_timesteps: int = setting(20_000, Effect.LENGTH, Bounds(1))  # environment steps
    n_envs: int = setting(64, Bounds(1, MOST_ENVS))  # environments that step together
    # b of b / sqrt(N), added to a reward of training for an action that was taken there N times; 0 for none
    exploration_bonus: float = setting(0.0, Bounds(0, MOST_BONUS))
    exploring_starts: float = setting(0.0, Privilege("starts anywhere"), Bounds(0, 1))
    # whether environments in one state share out an action's outcomes evenly, see `gridworld.envs.vector_env`
    stratified_draws: bool = setting(False, Privilege("stratified draws"))
    device: Word = setting("cpu", Effect.MACHINE)
    threads: int = setting(1, Effect.MACHINE, Bounds(1, MOST_THREADS))  # of torch
    callbacks: list[Callback] = setting(list)
    agent: AgentConfig = setting(AgentConfig)  # the chosen agent's own schema in its place
    env: EnvConfig = setting(MapConfig, Effect.TASK)  # of the chosen source (`config.worlds`)
    observation: ObservationConfig = setting(ObservationConfig)
    evaluation: EvaluationConfig = setting(EvaluationConfig, Effect.EVALUATION)
    logging: LoggingConfig = setting(LoggingConfig, Effect.FILES)
    recording: RecordingConfig = setting(RecordingConfig, Effect.FILES)
    checkpoint: CheckpointConfig = setting(CheckpointConfig, Effect.NOTHING)


def check(config: TrainConfig) -> None:
    """Check the values that no type can. Maps, rewards and what is the agents' own are checked elsewhere."""
    check_bounds(config)
    source = getattr(config.env, "source", None)
    if source is not None and SOURCES.get(source) is not type(config.env):
        raise InputError(f"env.source={source}: is not a setting; choose a source by env=...")
    every = config.checkpoint.every
    if not (every is None or every == AUTO or (type(every) is int and 1 <= every < LARGEST_INTEGER)):
        raise InputError(
            f"checkpoint.every={every}: must be a number of steps, {AUTO}, or null for no checkpoints"
        )


def check_bounds(section: Any, prefix: str = "") -> None:
    """Check the numbers of a section of the settings, and of those in it, against their fields' bounds."""
    schema: type = type(section)
    for name, found in declared(schema).items():
        key, value = prefix + name, getattr(section, name)
        if is_dataclass(value):
            check_bounds(value, f"{key}.")
        elif Bounds in found and value is not None:
            found[Bounds].check(key, value)
