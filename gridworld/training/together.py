"""Several trainings in one thread, of which those of one kind learn as one population.

A training is a generator: it prepares a run, yields one `Learning`, and when that has ended it writes what
was learnt and returns its result. So one training can run alone, or several can be prepared, learn at once,
and end one after the other, and none can tell the difference. Each runs in a context of its own.
"""

from __future__ import annotations

import contextvars
import dataclasses
import time
from collections.abc import Callable, Generator, Sequence
from typing import Any, Generic, TypeVar

from gridworld.agents import Learning, learn_together
from gridworld.process.together import Clock, set_clock

T = TypeVar("T")
Training = Generator[Learning, None, T]


def run_alone(training: Training[T]) -> T:
    """Run a training; returns what it returns, and raises what it raises."""
    try:
        learning = next(training)
        try:
            learning.agent.learn(
                learning.total_timesteps, learning.on_step, learning.on_safe_point, learning.state
            )
        except BaseException as error:
            training.throw(error)
        else:
            next(training)
    except StopIteration as end:
        result: T = end.value
        return result
    raise RuntimeError("a training yields once")


def run_together(trainings: Sequence[Callable[[], Training[T]]]) -> list[T | Exception]:
    """Run trainings until all have ended.

    Args:
        trainings: make the generators; they begin in this order.

    Returns:
        What each returned, or the exception that it raised.

    Raises:
        SystemExit: a training raised it. The others ran to their ends; those that had not begun were left
            out.
        BaseException: one of another kind that is not an `Exception`. It was raised in the others too.
    """
    together = _Together(len(trainings))
    runs = [_Run(begin, together) for begin in trainings]
    try:
        for run in runs:
            if together.exit is None:
                run.resume()
        learning = [run for run in runs if run.learning is not None]
        for run, error in zip(learning, together.learn(learning), strict=True):
            run.error = error
        for run in learning:
            run.resume()
    except BaseException as stop:
        for run in runs:
            run.end(stop)
        raise
    if together.exit is not None:
        raise together.exit
    return [run.result for run in runs]  # type: ignore[misc]


class _Together:
    """What runs share: the time in which they learn at once, and the first `SystemExit`."""

    def __init__(self, runs: int) -> None:
        self.exit: SystemExit | None = None
        self._runs = runs
        self._started: float | None = None
        self._seconds = self._apart = 0.0  # while all learn, and of these the seconds of single runs

    def learn(self, runs: Sequence[_Run[T]]) -> list[BaseException | None]:
        self._started = time.perf_counter()
        try:
            return learn_together([run.learning for run in runs if run.learning is not None])
        finally:
            self._seconds, self._started = self._elapsed() + self._apart, None

    def share(self) -> float:
        """A run's share of the seconds in which all learnt."""
        return self._elapsed() / self._runs

    def apart(self, call: Callable[[int], Any], steps: int) -> Any:
        """Call something that is one run's alone."""
        before = self._elapsed()
        try:
            return call(steps)
        finally:
            self._apart += self._elapsed() - before

    def _elapsed(self) -> float:
        now = 0.0 if self._started is None else time.perf_counter() - self._started
        return self._seconds + now - self._apart


class _Run(Generic[T]):
    """A training, in a context of its own."""

    def __init__(self, begin: Callable[[], Training[T]], together: _Together) -> None:
        self.learning: Learning | None = None
        self.error: BaseException | None = None  # that learning ended with
        self.result: T | Exception | None = None
        self._together, self._begin = together, begin
        self._training: Training[T] | None = None
        self._clock = Clock(together.share)
        self._context = contextvars.copy_context()
        self._context.run(set_clock, self._clock)

    def resume(self) -> None:
        """Let it come to where it learns, or to its end.

        Raises:
            BaseException: what it raises that is neither an `Exception` nor a `SystemExit`.
        """
        error, self.error = self.error, None
        try:
            if self._training is None:
                self._training = self._call(self._begin)
            assert self._training is not None
            resume = (next, self._training) if error is None else (self._training.throw, error)
            learning = self._call(*resume)
        except StopIteration as end:
            self.result = end.value
        except Exception as failure:
            self.result = failure
        except SystemExit as stop:
            self._together.exit = self._together.exit or stop
        else:
            save = learning.on_safe_point
            self.learning = dataclasses.replace(
                learning,
                on_step=self._own(learning.on_step),
                on_safe_point=None if save is None else self._own(save),
            )
            return
        self.learning = self._training = None

    def end(self, stop: BaseException) -> None:
        """Raise something in it, if it has begun and not ended."""
        if self._training is not None:
            try:
                self._call(self._training.throw, self.error or stop)
            except BaseException:  # it may raise another one on its way out
                self._training = None

    def _own(self, hook: Callable[[int], Any]) -> Callable[[int], Any]:
        """A hook that is called in this run's context, on its own time."""
        return lambda steps: self._together.apart(lambda at: self._call(hook, at), steps)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        with self._clock.running():
            return self._context.run(function, *arguments)
