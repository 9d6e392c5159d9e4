"""Agents: what learns. A family of algorithms is a package here, with the schemas of its agents in `SCHEMAS`.

They are by their names in Hydra's group `agent/schema`. Importing the package must not import torch.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gridworld.base.serialization import State
    from gridworld.envs.observations import ObservationTable
    from gridworld.envs.training_env import TrainingVectorEnv
    from gridworld.world.evaluation import PolicySnapshot

WriteScalars = Callable[[Mapping[str, float], int], None]  # ({tag: value}, environment steps)
Hook = Callable[[int], int]  # see `Agent.learn`
SafePoint = Callable[[int], None] | None


@dataclass(frozen=True, eq=False)
class TrainingContext:
    """What an agent learns on."""

    envs: TrainingVectorEnv  # which reset in the same step
    observation: ObservationTable  # what it sees of a state
    seed: int  # of its own random numbers and of the environments'
    device: str  # torch's name of a device, or `auto`
    threads: int = 1  # of its numerical library
    write_scalars: WriteScalars | None = None  # takes its training metrics; None: they are not wanted
    callbacks: Sequence[Any] = ()  # the configured ones, as plain values (`config.train.TrainConfig`)
    features: Mapping[str, Any] = field(default_factory=dict)  # an observation's, of an `MlpPolicy`
    only_asked: bool = False  # it will not learn, and needs no memory for transitions


class Agent(ABC):
    """One agent with its environments."""

    @property
    @abstractmethod
    def model(self) -> Any:
        """What it has learned, as its library has it: a model of SB3, or a table Q (S, A)."""

    @abstractmethod
    def learn(
        self, total_timesteps: int, on_step: Hook, on_safe_point: SafePoint = None, state: State | None = None
    ) -> None:
        """Learn for so many environment steps.

        Args:
            total_timesteps: environment steps, from the very start; a whole last batch counts.
            on_step: called with the steps so far after a batch of steps; it returns the steps by which it is
                to be called again at the latest, and 0 where learning is to end.
            on_safe_point: called with the steps so far where nothing is half done, so that `get_state` is
                complete, and once more at the end if that is such a point.
            state: of `get_state`, to continue from; None: from the start.

        Raises:
            ValueError: `state` does not fit.
            InputError: training diverged.
        """

    def class_without_state(self) -> str | None:
        """The path of a class of which nobody knows what it keeps, so that `get_state` cannot be complete."""
        return None

    def acts_by(self) -> str | None:
        """The path of a class whose own `predict` decides on the best action; None: what it learned does."""
        return None

    @abstractmethod
    def get_state(self) -> State:
        """Everything that learning depends on from here, its environments included."""

    @abstractmethod
    def snapshot(self) -> PolicySnapshot:
        """What it has learned so far, in arrays of their own."""

    @abstractmethod
    def model_file(self) -> bytes:
        """What it has learned so far, as the content of a model file."""

    @abstractmethod
    def load(self, path: Path) -> None:
        """Take the parameters from a model file; InputError: they cannot be read, or do not fit."""


@dataclass(eq=False)
class Learning:
    """An agent that is about to learn, with the arguments of `Agent.learn`."""

    agent: Agent
    total_timesteps: int
    on_step: Hook
    on_safe_point: SafePoint = None
    state: State | None = None


def learn_together(learnings: Sequence[Learning]) -> list[BaseException | None]:
    """Let agents learn, those of a class with a `learn_together` of its own at once.

    Returns:
        What each ended with; None where it came to its end.
    """
    errors: list[BaseException | None] = [None] * len(learnings)
    classes: dict[type, list[int]] = {}
    for place, each in enumerate(learnings):
        if hasattr(each.agent, "learn_together"):
            classes.setdefault(type(each.agent), []).append(place)
            continue
        try:
            each.agent.learn(each.total_timesteps, each.on_step, each.on_safe_point, each.state)
        except BaseException as error:
            errors[place] = error
    for places in classes.values():
        first: Any = learnings[places[0]].agent
        ends = first.learn_together([learnings[place] for place in places])
        for place, end in zip(places, ends, strict=True):
            errors[place] = end
    return errors


def misfit(found: Mapping[str, NDArray[Any]], expected: Mapping[str, NDArray[Any]]) -> str | None:
    """The first name, type, shape or number of a model's arrays that does not fit; None: all do."""
    import numpy as np

    for name in sorted(found.keys() ^ expected.keys()):
        return f"{name[:80]} is {'missing' if name in expected else 'not part of it'}"
    for name, like in expected.items():
        is_now, must_be = (f"{each.dtype} {each.shape}" for each in (found[name], like))
        if is_now != must_be:
            return f"{name} is {is_now}, it must be {must_be}"
        if not np.isfinite(found[name]).all():
            return f"{name} contains numbers that are not finite"
    return None
