"""One training run: a world, an agent, its learning curve, and what it comes to."""

from __future__ import annotations

import dataclasses
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from gridworld.agents import Agent, Seat, family
from gridworld.chain import one_hot_policy
from gridworld.config import EnvConfig, TrainConfig, check
from gridworld.counted_env import CountedVectorEnv
from gridworld.curve import GREEDY, Curve
from gridworld.errors import InputError
from gridworld.evaluation import Judge, Score
from gridworld.events import EventWriter, HParamValue
from gridworld.files import write_array, write_json
from gridworld.layout import Layout, load
from gridworld.mdp import Mdp, compile_mdp
from gridworld.observations import ObservationTable, make_observation
from gridworld.pictures import Pictures, check_recording
from gridworld.run import Run

HPARAM_METRICS = tuple(
    f"{GREEDY}/{name}" for name in ("value", "regret", "goal_probability", "length", "certified")
)

Summary = dict[str, Any]


class Interrupted(BaseException):
    """Training was asked to stop (Ctrl-C or SIGTERM); the run's files are closed and say so."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signal_number).name}")
        self.exit_code = 128 + signal_number


def make_mdp(env: EnvConfig, layout: Layout | None = None) -> Mdp:
    """The world of these settings; `layout` stands in for the configured map."""
    if layout is None:
        layout = load(env.layout, env.num_rows, env.num_cols)
    return compile_mdp(layout, env.slip, env.step_reward, env.goal_reward, env.trap_reward)


def train(
    config: TrainConfig, run: Run, overrides: list[str], world: Callable[[EnvConfig], Mdp] = make_mdp
) -> Summary:
    """Train, evaluate and record as configured; everything it writes goes to the run's folder.

    `world` makes the configured world, or has it at hand. Raises `InputError` for a mistake in the settings,
    before anything is written, and `Interrupted`.
    """
    mdp = check_settings(config, world)
    observation = make_observation(mdp, config.observation.kind, config.observation.cell_size)
    judge = Judge(mdp, config.evaluation.gamma, config.env.max_episode_steps)
    log = _Log()
    seat = make_seat(config, mdp, observation, log)
    agent = family(config.agent).build(config.agent, seat)

    run.start(dataclasses.asdict(config), mdp.layout.text(), overrides)
    try:
        with signals_raise():
            summary = _learn(config, run, judge, agent, seat, log)
    except Interrupted as interruption:
        run.end("interrupted", str(interruption))
        raise
    except BaseException as error:
        run.end("failed", str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}")
        raise
    run.end("finished")
    return summary


def check_settings(config: TrainConfig, world: Callable[[EnvConfig], Mdp] = make_mdp) -> Mdp:
    """The run's world, once everything is checked that can be without the agent's library.

    `world` makes it, or finds it where many runs share one. Raises `InputError`.
    """
    check(config)
    family(config.agent).check(config)
    mdp = world(config.env)
    check_recording(config, mdp)
    return mdp


def make_seat(config: TrainConfig, mdp: Mdp, observation: ObservationTable, log: _Log | None = None) -> Seat:
    """Environments and observations for an agent of this configuration."""
    envs = CountedVectorEnv(config.n_envs, max_episode_steps=config.env.max_episode_steps, **mdp.settings())
    return Seat(
        envs,
        observation,
        config.seed,
        config.device,
        config.threads,
        write_scalars=log.scalars if log is not None and config.logging.tensorboard else None,
    )


class _Log:
    """The agent's way to the event file, which is opened only when everything else is ready."""

    events: EventWriter | None = None

    def scalars(self, values: Any, step: int) -> None:
        if self.events is not None:
            self.events.scalars(values, step)


def _learn(config: TrainConfig, run: Run, judge: Judge, agent: Agent, seat: Seat, log: _Log) -> Summary:
    curve = Curve(judge, agent, config, run.curve_file, seat.envs)
    events = EventWriter(run.folder) if config.logging.tensorboard else None
    succeeded = False
    try:
        if events is not None:
            log.events = events
            events.hparams(hparams(config), HPARAM_METRICS)
            curve.log_to(events)
        pictures = Pictures(config, run, judge, events)
        curve.watched_by(pictures.see)
        curve.evaluate(0)
        steps, seconds = _timed_learning(config, agent, curve)
        curve.evaluate(steps)
        agent.save(run.model_file)
        write_array(run.visits_file, seat.envs.visits)
        summary = _summarise(config, curve, steps, seconds)
        write_json(run.summary_file, _plain(summary))
        assert curve.beliefs is not None
        pictures.finish(steps, curve.beliefs, seat.envs.visits)
        succeeded = True
    finally:
        curve.close()
        if events is not None:
            events.end_session(succeeded)
            events.close()
    return summary


def _plain(content: Any) -> Any:
    """The same with null for what JSON has no number for: an endless walk at γ = 1 is worth -inf."""
    if isinstance(content, dict):
        return {key: _plain(value) for key, value in content.items()}
    return None if isinstance(content, float) and not math.isfinite(content) else content


def _timed_learning(config: TrainConfig, agent: Agent, curve: Curve) -> tuple[int, float]:
    """Environment steps and seconds; the seconds include the evaluations."""
    steps = 0

    def on_step(done: int) -> bool:
        nonlocal steps
        steps = done
        return curve.on_step(done)

    started = time.perf_counter()
    agent.learn(config.total_timesteps, on_step)
    return steps, time.perf_counter() - started


def _summarise(config: TrainConfig, curve: Curve, steps: int, seconds: float) -> Summary:
    judge, greedy, sampled, beliefs = curve.judge, curve.greedy, curve.sampled, curve.beliefs
    assert greedy is not None
    assert sampled is not None
    assert beliefs is not None
    return {
        "agent": config.agent.name,
        "env": judge.mdp.layout.name,
        "observation": config.observation.kind,
        "seed": config.seed,
        "total_timesteps": config.total_timesteps,
        "timesteps": steps,
        "gamma": config.evaluation.gamma,
        "certified": greedy.certified,
        "first_certified_step": curve.first_certified_step,
        "certified_since_step": curve.certified_since_step,
        "optimal_value": judge.optimal_value,
        "optimal_goal_probability": judge.optimum.goal,
        "optimal_length": judge.optimum.expected_length,
        **_scores(greedy),
        "endless_cells": judge.endless_cells(one_hot_policy(beliefs.greedy)),
        "sampled": _scores(sampled),
        "train_seconds": round(seconds, 3),
        "evaluation_seconds": round(curve.seconds, 3),
    }


def _scores(score: Score) -> dict[str, float]:
    """A score as the summary's fields; the certificate stands there once, for the greedy policy."""
    return {name: number for name, number in score.numbers().items() if name != "certified"}


def hparams(config: TrainConfig) -> dict[str, HParamValue]:
    """The settings that make a difference to learning, flat: {"agent.learning_rate": 0.003, ...}."""
    content = dataclasses.asdict(config)
    for told_elsewhere in ("logging", "recording"):
        del content[told_elsewhere]
    return dict(_flatten(content))


def _flatten(content: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, HParamValue]]:
    for key, value in content.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        elif value is None or isinstance(value, bool | int | float | str):
            yield prefix + key, value
        else:
            yield prefix + key, str(value)


@contextmanager
def signals_raise() -> Iterator[None]:
    """SIGINT and SIGTERM raise `Interrupted` in the main thread, so that files are closed on the way out."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Interrupted(number)

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
