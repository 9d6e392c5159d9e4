"""Settings that all agents share, and the place where the agents' own schemas are found.

An agent's schema is in its family's package in `gridworld/agents`. `agent_schemas` collects them at run time:
the only place where this room reaches a room above it, by a package's name, not by an import statement.
"""

from __future__ import annotations

import functools
import importlib
import math
import pkgutil
from dataclasses import dataclass, field
from typing import Annotated, Any, Union

from gridworld.config.fields import ClassPath, Effect, Text, Word, affects
from gridworld.errors import InputError

MISSING = "???"  # OmegaConf's sign for a value that has to be given
MOST_KEPT = 10**9  # episodes that a mean is taken over
LINEAR = "lin_"  # lin_0.003: from 0.003 at the start, linearly, to 0 at the end, as RL Zoo writes it
_POWERS = {LINEAR: 1.0, "sqrt_": 0.5, "quad_": 2.0}  # of what is left of training, by a schedule's prefix

REPLAY_COUNTS = "gridworld.agents.sb3.replay_counts.ReplayCounts"  # a replay buffer that counts transitions

# OmegaConf reads these annotations at run time and knows no `X | None`.
Schedule = Union[int, float, Word]  # noqa: UP007
WholeNumbers = Annotated[Any, Text.WORD, "a whole number, or lists and dicts of them"]


@dataclass
class AgentConfig:
    """The settings of any agent."""

    name: Word = field(default=MISSING, metadata=affects(Effect.LABELS))  # in tables and folders
    family: Word = MISSING  # the package in `gridworld.agents`
    algorithm: ClassPath = MISSING  # the class, by its import path where it is none of ours

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


@functools.cache
def agent_schemas() -> dict[str, type[AgentConfig]]:
    """The schemas of all agents by their names in Hydra's group `agent/schema`."""
    agents = importlib.import_module("gridworld.agents")
    found: dict[str, type[AgentConfig]] = {}
    for family in pkgutil.iter_modules(agents.__path__):
        found |= importlib.import_module(f"{agents.__name__}.{family.name}").schemas()
    return found


@dataclass(frozen=True)
class Decay:
    """A rate over training.

    Attributes:
        initial: at the start, finite and not negative.
        power: of the share of training that is left, with which it falls to 0; with 0 it stays.
    """

    initial: float
    power: float

    def at(self, progress: float) -> float:
        """The rate after this share of training, from 0 to 1."""
        return float(self.initial * (1 - progress) ** self.power)


def falls(value: object) -> bool:
    """Whether a setting's value is written as a rate that falls, as `lin_NUMBER` is."""
    return isinstance(value, str) and value.startswith(tuple(_POWERS))


def parse_schedule(key: str, value: Schedule, linear_only: bool = False) -> Decay:
    """Read a rate that may fall over training.

    Args:
        key: the setting's dotted name, for the message.
        value: a number, or one of `lin_NUMBER`, `sqrt_NUMBER` and `quad_NUMBER`.
        linear_only: whether the last two are refused.
    """
    form, digits = "", value
    if isinstance(value, str):
        form = next((form for form in _POWERS if value.startswith(form)), "")
        digits = value.removeprefix(form) if form and "_" not in value.removeprefix(form) else "nan"
    try:
        number = float(digits)
    except (ValueError, OverflowError):
        number = math.nan
    if not 0 <= number < math.inf or (linear_only and form not in ("", LINEAR)):
        others = "" if linear_only else " (sqrt_, quad_: for one by a root or a square)"
        raise InputError(
            f"{key}={value}: must be a number of at least 0, or {LINEAR}NUMBER for a linear decay{others}"
        )
    return Decay(number, _POWERS.get(form, 0.0))
