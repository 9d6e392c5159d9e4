"""A trial update on a copy before a run begins, for settings that only the algorithm's class can check.

Algorithms of the libraries alone are rehearsed: one's own may do anything while it trains, which should not
be done twice. The copy has environments of its own, few of them, and its rollout and batches are cut short,
so that it takes some hundredths of a second. Nothing that the run depends on is touched. Where the copy
fails, another one with the run's own sizes is asked before anything is refused. The setting to blame is found
by leaving out one after the other: without it, the update can be made.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from gridworld.agents import TrainingContext
from gridworld.agents.sb3.factory import UnfitError, make_model, said
from gridworld.agents.sb3.policy_outputs import why_no_table
from gridworld.agents.sb3.rollback import rolled_back
from gridworld.agents.sb3.settings.constructor_arguments import algorithm_and_arguments
from gridworld.agents.sb3.settings.schemas import SB3CheckedConfig, SB3ClassConfig, SB3Config
from gridworld.agents.sb3.settings.validation import left_to_the_class
from gridworld.agents.sb3.snapshot.callback import not_finite
from gridworld.agents.sb3.snapshot.class_state import is_known
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError

_FEW_ENVS, _FEW_SAMPLES, _FEW_STEPS = 64, 256, 4
_REPEATS = ("n_epochs", "gradient_steps", "n_critic_updates")  # of an update, by the names that classes use

MakeContext = Callable[[int], TrainingContext]  # with so many environments of its own


def rehearse(config: TrainConfig, make_context: MakeContext) -> None:
    """Make a first update with a copy of the model, see above.

    Args:
        config: the run's settings.
        make_context: makes a context with so many environments.

    Raises:
        InputError: the configured class cannot make a first update with its settings.
    """
    agent = config.agent
    assert isinstance(agent, SB3Config)
    torch.set_num_threads(config.threads)
    with rolled_back():  # what is imported may draw, too
        algorithm, arguments = algorithm_and_arguments(agent)
    if not is_known(algorithm.__module__):
        return
    with rolled_back(*_classes(arguments)):
        rehearsal = _Rehearsal(config, make_context)
        fault = rehearsal.fault(agent, is_short=True) and rehearsal.fault(agent, is_short=False)
        culprit = fault and next(
            (setting for setting, other in _others(agent) if rehearsal.works(other)), None
        )
    if culprit:
        raise InputError(f"{culprit}: {agent.algorithm} {fault}; without this setting it can")
    if fault:
        raise InputError(f"agent={agent.name}: {agent.algorithm} {fault}")


@dataclass(frozen=True)
class _Rehearsal:
    config: TrainConfig
    make_context: MakeContext

    def works(self, agent: SB3Config) -> bool:
        try:
            return self.fault(agent, is_short=True) is None
        except InputError:
            return False

    def fault(self, agent: SB3Config, is_short: bool) -> str | None:
        """What goes wrong by the end of the first update; None: nothing. Raises `InputError` if we know."""
        num_envs = self.config.n_envs
        context = self.make_context(min(num_envs, _FEW_ENVS) if is_short else num_envs)
        try:
            model = make_model(agent, context)
        except UnfitError as error:
            return error.reason
        if is_short:
            _shorten(model)
        model.set_logger(Logger(folder=None, output_formats=[]))
        problem = why = None
        try:
            model.learn(self.config.total_timesteps, _UntilUpdated(), agent.log_interval)
            why = why_no_table(model.policy, context.observation)
        except Exception as error:  # the class may be anybody's
            problem = said(error)
        with contextlib.suppress(ValueError):  # weights may still have no shape
            problem = not_finite(model) or problem
        return why if problem is None else f"cannot make its first update: {problem}"


class _UntilUpdated(BaseCallback):
    """Ends training at the first step after an update."""

    def __init__(self) -> None:
        super().__init__()
        self._is_updated = False

    def _on_rollout_start(self) -> None:
        self._is_updated = self.model.num_timesteps > max(getattr(self.model, "learning_starts", 0), 0)

    def _on_step(self) -> bool:
        return not self._is_updated


def _shorten(model: Any) -> None:
    """Cut down what an update takes in, and how often it goes over it."""
    if isinstance(getattr(model, "rollout_buffer", None), RolloutBuffer):
        batch = min(getattr(model, "batch_size", 0), _FEW_SAMPLES)
        if batch:
            model.batch_size = batch
        steps = min(model.n_steps, max(_FEW_STEPS, -(-batch // model.n_envs)))
        model.n_steps = model.rollout_buffer.buffer_size = steps
    if isinstance(getattr(model, "train_freq", None), TrainFreq):
        count = min(model.train_freq.frequency, _FEW_STEPS)
        model.train_freq = TrainFreq(count, TrainFrequencyUnit.STEP)
        model.learning_starts = 0
    for name in _REPEATS:
        if isinstance(getattr(model, name, None), int):
            setattr(model, name, min(getattr(model, name), 1))


def _classes(arguments: Any) -> Iterator[type]:
    if isinstance(arguments, type):
        yield arguments
    elif isinstance(arguments, dict):
        for value in arguments.values():
            yield from _classes(value)


def _others(agent: SB3Config) -> Iterator[tuple[str, SB3Config]]:
    """(`key=value`, the agent without it) of every setting that only its class can judge."""
    if isinstance(agent, SB3ClassConfig):
        for where, holder in (("", ()), ("policy_kwargs.", ("policy_kwargs",))):
            for name, value in _inner(agent.arguments, holder).items():
                other = copy.deepcopy(agent)
                del _inner(other.arguments, holder)[name]
                if name != "policy_kwargs":
                    yield f"agent.arguments.{where}{name}={value}", other
        return
    assert isinstance(agent, SB3CheckedConfig)
    for name in left_to_the_class(agent):
        value, default = getattr(agent, name), getattr(type(agent)(), name)
        if name != "policy_kwargs":
            yield f"agent.{name}={value}", dataclasses.replace(agent, **{name: default})
            continue
        for key in vars(value):
            given, plain = getattr(value, key), getattr(default, key)
            if given != plain:
                kwargs = dataclasses.replace(value, **{key: plain})
                yield f"agent.{name}.{key}={given}", dataclasses.replace(agent, policy_kwargs=kwargs)


def _inner(arguments: dict[str, Any], path: tuple[str, ...]) -> dict[str, Any]:
    for name in path:
        arguments = arguments.get(name) or {}
    return arguments
