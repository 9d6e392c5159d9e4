"""Several trainings in one thread, of which those of one kind learn as one population.

A training is a generator: it prepares a run, yields one `Learning`, and when that has ended it writes what
was learned and returns its result. So one training can run alone, or several can be prepared, learn at once,
and end one after the other, and none can tell the difference. Each runs in a context of its own.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Generator, Sequence
from contextvars import copy_context
from typing import Generic, ParamSpec, TypeVar

from gridworld.agents import Learning, learn_together
from gridworld.base.together import share_clock

P = ParamSpec("P")
T = TypeVar("T")
Training = Generator[Learning, None, T]


def run_alone(training: Training[T]) -> T:
    """Run a training; returns what it returns, and raises what it raises."""
    (result,) = run_together([training])
    if isinstance(result, Exception):
        raise result
    return result


def alone(training: Callable[P, Training[T]]) -> Callable[P, T]:
    """The same function, which runs its training instead of returning it."""
    return lambda *arguments, **settings: run_alone(training(*arguments, **settings))


def run_together(trainings: Sequence[Training[T]]) -> list[T | Exception]:
    """Run trainings, which begin in this order; returns what each returned, or its `Exception`.

    Where one raises `SystemExit`, those that have begun end first, the others are left out, and it is raised.
    Any other exception, such as a signal's, is raised in the others too.
    """
    runs = [_Run(training, len(trainings)) for training in trainings]
    try:
        for run in runs:
            if not any(other.exit for other in runs):
                run.resume()
        learning = [run for run in runs if run.learning is not None]
        errors = learn_together([run.learning for run in learning if run.learning is not None])
        for run, error in zip(learning, errors, strict=True):
            run.error = error
        for run in learning:
            run.resume()
    except BaseException as stop:
        for run in runs:
            run.end(stop)
        raise
    for run in runs:
        if run.exit is not None:
            raise run.exit
    return [run.result for run in runs]  # type: ignore[misc]


class _Run(Generic[T]):
    """One of several trainings, in a context of its own."""

    def __init__(self, training: Training[T], runs: int) -> None:
        self.learning: Learning | None = None
        self.error: BaseException | None = None  # that learning ended with
        self.result: T | Exception | None = None
        self.exit: SystemExit | None = None
        self._training = training
        self._context = copy_context()
        self._context.run(share_clock, runs)

    def resume(self) -> None:
        """Let it come to where it learns, or to its end; raises only what stops all of them."""
        error, self.error = self.error, None
        try:
            if error is None:
                learning = self._context.run(next, self._training)
            else:
                learning = self._context.run(self._training.throw, error)
        except StopIteration as end:
            self.result = end.value
        except Exception as failure:
            self.result = failure
        except SystemExit as stop:
            self.exit = stop
        else:
            save = learning.on_safe_point
            context, step = self._context, learning.on_step  # a hook that knew `self` would be a circle
            self.learning = dataclasses.replace(
                learning,
                on_step=lambda steps: context.run(step, steps),
                on_safe_point=None if save is None else lambda steps: context.run(save, steps),
            )

    def end(self, stop: BaseException) -> None:
        """Raise what it learned with, or `stop`, in it; nothing happens if it has not begun or has ended."""
        with contextlib.suppress(BaseException):  # it may raise another one on its way out
            self._context.run(self._training.throw, self.error or stop)
