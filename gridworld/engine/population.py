"""P runs of one algorithm that train as arrays: what each has to itself, what they share, their state."""

from __future__ import annotations

import functools
import itertools
import time
import weakref
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from gridworld.base.bounds import Decay
from gridworld.base.console import tell
from gridworld.base.errors import InputError
from gridworld.base.serialization import (
    State,
    StateError,
    fill,
    fitting,
    generator_state,
    set_generator_state,
)
from gridworld.base.together import mixed
from gridworld.engine.environments import Environments
from gridworld.engine.networks import DenseNetworks, Networks, StateNetwork, make_networks
from gridworld.engine.optimizer import Optimizer
from gridworld.envs.training_env import TrainingVectorEnv
from gridworld.world.mdp import BoolArray, FloatArray, IntArray

FEW_STATES = 1024  # up to here all states are cheaper than finding out which ones a batch holds


@dataclass(eq=False)
class Run:
    """What one run of a population has to itself, besides its row of the arrays."""

    model: Any  # SB3's own, for settings, counters and the names of logged values; its weights are stale
    network: StateNetwork
    target: StateNetwork | None  # where it has a target network
    envs: TrainingVectorEnv  # for their generator and their statistics
    torch_generator: torch.Generator  # in place of torch's own
    numpy_generator: np.random.RandomState  # in place of numpy's own
    reward_scale: float = 1.0  # that rewards are multiplied by
    falling: Mapping[str, Decay] = field(default_factory=dict)  # settings that fall as SB3 lets none fall
    log_interval: int = 1  # as SB3's `learn` takes it
    counts_transitions: bool = False  # whether its replay counts transitions
    shape: Hashable = None  # what runs of one population have in common of their settings
    population: Population = field(init=False, repr=False)
    row: int = field(init=False, default=0)
    total_timesteps: int = field(init=False, default=0)
    next_call: int = field(init=False, default=0)  # the steps by which `on_step` wants to be called
    on_step: Callable[[int], int] | None = field(init=False, default=None)
    on_safe_point: Callable[[int], None] | None = field(init=False, default=None)
    error: BaseException | None = field(init=False, default=None)  # that it ended with
    has_ended: bool = field(init=False, default=False)  # before its last step
    failed_update: Exception | None = field(init=False, default=None)  # the same, where an update failed

    def __post_init__(self) -> None:
        self.begin(1)

    @functools.cached_property
    def met(self) -> IntArray | None:
        """The states (U,) of a large world that it can meet within its step limit; None if those are all.

        Without weight decay, a first layer of unit vectors never changes in the columns of the others.
        """
        mdp, settings = self.envs.mdp, self.model.policy.optimizer.param_groups[0]
        if mdp.num_states <= FEW_STATES or not self.network.is_look_up or settings.get("weight_decay"):
            return None
        found, front = mdp.start > 0, mdp.start_states
        for _ in range(min(self.envs.step_limit, mdp.num_states)):
            following = mdp.next_state[front][mdp.probability[front] > 0]
            front = np.unique(following[~found[following]])
            found[front] = True
        return None if found.all() else np.flatnonzero(found)

    def begin(self, total_timesteps: int) -> None:
        """Prepare SB3's model as its `learn` does."""
        self.total_timesteps, self.has_ended, model = total_timesteps, False, self.model
        model._total_timesteps, model._num_timesteps_at_start = total_timesteps, 0
        model.start_time = time.time_ns()
        model.ep_info_buffer = deque(maxlen=model._stats_window_size)
        model.ep_success_buffer = deque(maxlen=model._stats_window_size)

    def setting(self, name: str, progress: float) -> float:
        """A setting after this share of training, from 0 to 1."""
        if name in self.falling:
            return self.falling[name].at(min(progress, 1.0))
        value = self.model.lr_schedule if name == "learning_rate" else getattr(self.model, name)
        return float(value(1 - progress) if callable(value) else value)

    def record(self, name: str, value: float, for_tensorboard: bool = True) -> None:
        self.model.logger.record(name, value, exclude=None if for_tensorboard else "tensorboard")

    def keep_episodes(self, returns: FloatArray, lengths: IntArray) -> None:
        """Note episodes that ended, as SB3's Monitor does."""
        seconds = round((time.time_ns() - self.model.start_time) / 1e9, 6)
        newest = slice(-self.model._stats_window_size, None)
        self.model.ep_info_buffer.extend(
            {"r": episode_return, "l": length, "t": seconds}
            for episode_return, length in zip(returns[newest].tolist(), lengths[newest].tolist(), strict=True)
        )

    def step_on(self, steps: int) -> None:
        """Call what wants to be called after these steps of the run; it may end the run."""
        self.model.num_timesteps = steps
        try:
            self.next_call = steps + 1 if self.on_step is None else self.on_step(steps)
        except BaseException as error:
            self.fail(error)
        else:
            if not self.next_call:
                self.population.end(self)

    def safe_point(self, steps: int) -> None:
        """Let the run be saved, where its state is whole."""
        try:
            if self.on_safe_point is not None:
                self.on_safe_point(steps)
        except BaseException as error:
            self.fail(error)

    def fail(self, error: BaseException) -> None:
        """End the run with an error, and leave the others as they are."""
        self.error = error
        self.population.end(self)

    def get_state(self) -> State:
        """Its generators, environments and counters, for `Population.get_state`."""
        model = self.model
        return {
            "torch_generator": self.torch_generator.get_state().numpy().copy(),
            "numpy_generator": self.numpy_generator.get_state(legacy=False),
            "action_generator": generator_state(model.action_space.np_random),
            "environments": self.envs.get_state(),
            "num_timesteps": int(model.num_timesteps),
            "num_updates": int(model._n_updates),
            "num_episodes": int(model._episode_num),
            **log_state(model),
        }

    def set_state(self, state: State) -> None:
        model = self.model
        if state["num_timesteps"] < 0 or state["num_updates"] < 0 or state["num_episodes"] < 0:
            raise StateError("counters must be at least 0")
        self.torch_generator.set_state(torch.from_numpy(state["torch_generator"]))
        # numpy takes a state without its last two keys, too
        keys = ("bit_generator", "state", "has_gauss", "gauss")
        self.numpy_generator.set_state({key: state["numpy_generator"][key] for key in keys})
        set_generator_state(model.action_space.np_random, state["action_generator"])
        self.envs.set_state(state["environments"])
        model.num_timesteps, model._n_updates = int(state["num_timesteps"]), int(state["num_updates"])
        model._episode_num = int(state["num_episodes"])
        set_log_state(model, state)


def log_state(model: Any) -> State:
    """The last episodes of SB3's model, what it has logged since it last wrote, and the seconds so far."""
    logger = model.logger
    return {
        "recent_episodes": [[each["r"], each["l"]] for each in model.ep_info_buffer],
        "logged": [
            [name, float(value), logger.name_to_count[name], "tensorboard" in (excluded or ())]
            for name, value in logger.name_to_value.items()
            for excluded in [logger.name_to_excluded[name]]
        ],
        "seconds": (time.time_ns() - model.start_time) / 1e9,
    }


def set_log_state(model: Any, state: State) -> None:
    model.ep_info_buffer.clear()
    model.ep_info_buffer.extend(
        {"r": float(each), "l": int(length), "t": 0.0} for each, length in state["recent_episodes"]
    )
    for name, value, count, is_excluded in state["logged"]:
        model.logger.record(name, float(value), exclude="tensorboard" if is_excluded else None)
        model.logger.name_to_count[name] = int(count)
    model.start_time = time.time_ns() - int(state["seconds"] * 1e9)


def diverged(model: Any, what: str) -> InputError:
    """The error to raise where `what` of SB3's model is not finite any more."""
    where = f"at update {model._n_updates:,}, after {model.num_timesteps:,} steps"
    return InputError(f"training diverged {where}: {what} is not finite; try a smaller learning rate")


class Population:
    """P runs of one algorithm in one world, equal by `kind`, from the start or from `states` of `get_state`.

    A run that has ended keeps its row, which changes no more, until the others make a smaller population.

    Attributes:
        active: (P,), the runs that have not ended.
        num_timesteps: environment steps of each run.
    """

    def __init__(self, runs: Sequence[Run], states: Sequence[State | None]) -> None:
        self._runs = [weakref.ref(run) for run in runs]
        for row, run in enumerate(runs):
            run.population, run.row = self, row
        first, mdp = runs[0], runs[0].envs.mdp
        self.num_envs, self.num_states = first.envs.num_envs, mdp.num_states
        self.num_actions = mdp.num_actions
        self.active: BoolArray = np.ones(len(runs), dtype=np.bool_)
        self.networks = make_networks([run.network for run in runs], first.met)
        self.optimizer = self._optimizer()
        for run, state in zip(runs, states, strict=True):
            if state is not None:
                self.set_state(run, state)
        self.num_timesteps = int(first.model.num_timesteps)
        self.environments = Environments([run.envs for run in runs])

    @property
    def runs(self) -> list[Run]:
        """They keep the population, and it does not keep them, or its arrays would wait for the collector."""
        return [run for each in self._runs if (run := each()) is not None]

    @classmethod
    def kind(cls, run: Run) -> Hashable:
        """Equal for runs that can form a population; of runs in large worlds each is of its own kind."""
        model, envs, mdp = run.model, run.envs, run.envs.mdp
        fits = mdp.num_states <= FEW_STATES and DenseNetworks.fit(run.network)
        if not fits or not (model.device.type == "cpu" or mixed()):
            return id(run)
        return (
            *(cls, run.shape, mdp.digest(), envs.num_envs, envs.step_limit, envs.stratified),
            *(repr(model.policy), str(model.device), run.reward_scale, run.network.digest()),
            *(model.num_timesteps, run.total_timesteps),
        )

    def _optimizer(self) -> Optimizer:
        own = [run.model.policy.optimizer for run in self.runs]
        norms = [getattr(run.model, "max_grad_norm", None) for run in self.runs]
        most = [np.inf if norm is None else float(norm) for norm in norms]
        return Optimizer(own, self.networks.weights, self.networks.gradients, most)

    def settings(self, name: str) -> list[float]:
        """(P,), a setting of each run at this time of training."""
        return [run.setting(name, self.progress(run)) for run in self.runs]

    def progress(self, run: Run) -> float:
        return self.num_timesteps / run.total_timesteps

    def learn(self, total_timesteps: int) -> None:
        """Train until all runs have ended, or have made so many environment steps."""
        population: Population | None = self.safe_point()
        while population is not None and population.num_timesteps < total_timesteps:
            population.iterate()
            population = population.safe_point()

    def iterate(self) -> None:
        """Make some environment steps, and an update."""
        raise NotImplementedError

    def going(self, chosen: BoolArray | bool = True) -> list[Run]:
        """The runs that have not ended, of those that are chosen (P,)."""
        return list(itertools.compress(self.runs, (self.active & chosen).tolist()))

    def end(self, run: Run) -> None:
        """Let a run take no further part."""
        self.active[run.row], run.has_ended = False, True

    def weights(self, run: Run) -> dict[str, tuple[Networks, Sequence[Tensor]]]:
        """The networks that a run has a row of, by their names in a state, and SB3's parameters for it."""
        return {"weights": (self.networks, run.network.parameters)}

    def snapshot(self, run: Run) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
        """What a run's network says of all states: values (S,), probabilities (S, A), Q (S, A), float64."""
        raise NotImplementedError

    def remaining(self) -> Self | None:
        """The population of the runs that have not ended, None if all have; the others are on their own."""
        if self.active.all():
            return self
        states, left = {run: self.get_state(run) for run in self.runs}, self.going()
        for run in states:
            if run.has_ended:
                type(self)([run], [states[run]])
        return type(self)(left, [states[run] for run in left]) if left else None

    def safe_point(self) -> Self | None:
        """Let all runs be saved, as nothing is half done; returns the population of those that go on."""
        finite = torch.isfinite(self.networks.weights.sum(dim=1)).cpu()  # a third of what asking each costs
        for run in self.going():
            if finite[run.row]:
                run.safe_point(self.num_timesteps)
            else:
                run.fail(diverged(run.model, "a weight"))
        return self.remaining()

    def check(self, finite: BoolArray, what: str) -> None:
        """End the runs (P,) that had a number that is not finite."""
        for run in self.going(~finite):
            run.fail(diverged(run.model, what))

    def get_state(self, run: Run) -> State:
        """All that a run's next steps depend on."""
        self.environments.put_back()
        return {
            **run.get_state(),
            "optimizer": self.optimizer.get_state(run.row),
            **{
                name: networks.whole()[run.row].cpu().numpy().copy()
                for name, (networks, _) in self.weights(run).items()
            },
        }

    def set_state(self, run: Run, state: State) -> None:
        run.set_state(state)
        for name, (networks, _) in self.weights(run).items():
            own = networks.whole()[run.row].cpu().numpy()
            fill(own, state[name], name)
            networks.set_row(run.row, torch.as_tensor(own))
        self.optimizer.set_state(run.row, state["optimizer"])


def train(runs: Sequence[Run], states: Sequence[State | None]) -> None:
    """Train runs that have begun until each has ended, those of one kind as a population.

    `states` are of `get_state`, or None; errors are in the runs' `error`.
    """
    groups: dict[Hashable, list[Run]] = {}
    for run, state in zip(runs, states, strict=True):
        if state is not None:
            try:
                with fitting():
                    type(run.population)([run], [state])
                run.model._current_progress_remaining = 1 - run.population.progress(run)
            except StateError as error:
                run.fail(error)
                continue
        groups.setdefault(run.population.kind(run), []).append(run)
    for group in groups.values():
        if len(group) > 1 and agree(group):
            type(group[0].population)(group, [run.population.get_state(run) for run in group])
        for population in dict.fromkeys(run.population for run in group):
            members = population.runs
            try:
                population.learn(group[0].total_timesteps)
            except Exception as error:  # torch's, of settings that only it can judge
                for run in members:
                    if not run.has_ended:
                        run.error = run.failed_update = error
    for run in runs:
        run.on_step = run.on_safe_point = None  # which hold what holds the run


_agreed: dict[Hashable, bool] = {}  # by kind, number of runs and threads


def agree(runs: Sequence[Run]) -> bool:
    """Whether these networks at once give the numbers of each alone, to the last bit, or need not.

    A batched product calls for each matrix the routine that it calls for one alone, on most processors and
    for most shapes. It is tried out once in a process for each kind and number of networks.
    """
    if len(runs) == 1 or mixed():
        return True
    key = runs[0].population.kind(runs[0]), len(runs), torch.get_num_threads()
    if key not in _agreed:
        _agreed[key] = _try_out(runs)
        if not _agreed[key]:
            tell(
                "population: on this processor, networks like these get other bits when batched; such runs "
                "train one by one"
            )
    return _agreed[key]


def _try_out(runs: Sequence[Run]) -> bool:
    generator, met = np.random.default_rng(0), runs[0].met
    together = make_networks([run.network for run in runs], met)
    outputs = [output.copy() for output in together.run()]
    slopes = [generator.normal(size=output.shape) for output in outputs]
    together.backward(*slopes)
    for row, run in enumerate(runs):
        alone, own = make_networks([run.network], met), slice(row, row + 1)
        same = all(
            np.array_equal(found, output[own]) for found, output in zip(alone.run(), outputs, strict=True)
        )
        alone.backward(*(slope[own] for slope in slopes))
        if not (same and torch.equal(alone.gradients[0], together.gradients[row])):
            return False
    return True
