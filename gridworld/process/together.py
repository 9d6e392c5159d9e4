"""Several tasks in one thread that meet wherever one piece of work can be done for all of them at once.

Each task is an ordinary function, such as a whole training run, in a greenlet of its own. It runs undisturbed
until it calls `meet`; there it waits for the others, the work is done for all that wait with the same key,
and each goes on. A task that ends, or fails, is not waited for. Outside of `run_together`, `meet` does the
work for the one that calls it. So no task can tell whether it runs alone. A task may begin others, and wait
for them, by `run_together` itself: they meet all that run together with it.

What a process has only once is changed over with the task: the generators of random numbers (Python's,
numpy's and torch's) and the context variables.
"""

from __future__ import annotations

import contextlib
import contextvars
import random
import sys
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from greenlet import getcurrent, greenlet

from gridworld.process.signals import stopped

T = TypeVar("T")
M = TypeVar("M")
LARGEST = 32  # runs that train together unless more are asked for; larger populations train no faster
_GLOBAL: Any = np.random  # numpy's stubs do not know all of its functions
Work = Callable[[Sequence[M]], Sequence[Exception | None]]


@dataclass(frozen=True)
class _Waiting(Generic[M]):
    """What a task waits for."""

    work: Work[M]
    member: M
    key: Hashable


class _Task(greenlet):  # type: ignore[misc]
    """A task, its outcome, and its own random numbers while it does not run."""

    def __init__(self, function: Callable[[], Any], beside: list[_Task], parent: greenlet) -> None:
        super().__init__(self._run, parent)
        self.gr_context = contextvars.copy_context()
        self._function = function
        self.beside = beside  # all that run together
        self.waiting: _Waiting[Any] | None = None
        self.begun: list[_Task] = []  # the tasks that it waits for
        self.result: Any = None
        self.error: BaseException | None = None
        self._bits = np.random.MT19937(0)
        self.chance = np.random.RandomState(self._bits)
        self.seconds = 0.0  # of its own work, and its share of what was done for several
        self.resumed = 0.0
        self._python = random.getstate()
        self._torch: Any = None

    def _run(self) -> None:
        try:
            self.result = self._function()
        except BaseException as error:
            self.error = error

    def resume(self, error: BaseException | None = None) -> None:
        """Let it run, with its random numbers, until it waits again or has ended; raise `error` in it."""
        torch = sys.modules.get("torch")
        outside = _GLOBAL.get_bit_generator(), random.getstate(), _torch_numbers(torch)
        _GLOBAL.set_bit_generator(self._bits)
        random.setstate(self._python)
        if torch is not None and self._torch is not None:
            torch.set_rng_state(self._torch)
        self.waiting = None
        self.resumed = time.perf_counter()
        try:
            if error is None:
                self.switch()
            elif self:
                self.throw(error)
            else:
                self.error = error  # it had not begun
                with contextlib.suppress(BaseException):
                    self.throw()
        finally:
            self.seconds += time.perf_counter() - self.resumed
            torch = sys.modules.get("torch")
            self._python, self._torch = random.getstate(), _torch_numbers(torch)
            bits, python, numbers = outside
            _GLOBAL.set_bit_generator(bits)
            random.setstate(python)
            if torch is not None and numbers is not None:
                torch.set_rng_state(numbers)


def run_together(tasks: Sequence[Callable[[], T]]) -> list[T | Exception]:
    """Run tasks until all have ended.

    Args:
        tasks: they begin in this order.

    Returns:
        What each returned, or the exception that it raised.

    Raises:
        SystemExit: a task raised it. The others have gone on until they ended.
        BaseException: one of another kind, which is no `Exception`. It was raised in the others too.
    """
    here = getcurrent()
    if isinstance(here, _Task):
        assert here.parent is not None
        here.begun = own = [_Task(function, here.beside, here.parent) for function in tasks]
        here.beside += own
        here.parent.switch()
    else:
        running: list[_Task] = []
        own = [_Task(function, running, here) for function in tasks]
        running += own
        _run_all(running)
    ends = [task.error for task in own if isinstance(task.error, SystemExit)]
    if ends:
        raise ends[0]
    return [task.result if task.error is None else _exception(task.error) for task in own]


def _run_all(running: list[_Task]) -> None:
    """Run tasks, and those that they begin, until all have ended and left the list."""

    def resume(task: _Task, error: BaseException | None = None) -> None:
        task.resume(error or stopped())
        if task.error is not None and not isinstance(task.error, Exception | SystemExit):
            raise task.error  # it is to end all tasks

    try:
        while running:
            for task in running:  # also those that are begun meanwhile
                if task.waiting is None and all(each.dead for each in task.begun):
                    resume(task)
            for task, error in _met([task for task in running if task.waiting is not None]):
                resume(task, error)
            running[:] = [task for task in running if not task.dead]
    except BaseException as stop:
        for task in running:
            while not task.dead:  # it may wait once more on its way out
                task.resume(stop)
        raise


def meet(work: Work[M], member: M, key: Hashable) -> None:
    """Have work done for this task and those that run together with it.

    Args:
        work: is called with the members of all tasks that wait for the same work with the same key; it
            returns the exception to raise in each, or None.
        member: this task's.
        key: what must be equal.

    Raises:
        Exception: what `work` returned for this task.
    """
    task = getcurrent()
    if not isinstance(task, _Task):
        (error,) = work([member])
        if error is not None:
            raise error
        return
    task.waiting = _Waiting(work, member, key)
    assert task.parent is not None
    task.parent.switch()


def chance() -> np.random.RandomState:
    """Numpy's global generator of random numbers, as this task has it also while it waits."""
    task = getcurrent()
    return task.chance if isinstance(task, _Task) else np.random.mtrand._rand


def clock() -> float:
    """Seconds since some moment; of a task among others, only those that were spent on it."""
    task = getcurrent()
    if not isinstance(task, _Task):
        return time.perf_counter()
    return task.seconds + time.perf_counter() - task.resumed


def _met(waiting: Sequence[_Task]) -> list[tuple[_Task, Exception | None]]:
    """Do the work that tasks wait for; returns what to raise in each, in their order."""
    groups: dict[Any, list[_Task]] = {}
    for task in waiting:
        assert task.waiting is not None
        groups.setdefault((task.waiting.work, task.waiting.key), []).append(task)
    errors: dict[_Task, Exception | None] = {}
    for (work, _), tasks in groups.items():
        started = time.perf_counter()
        found = work([task.waiting.member for task in tasks if task.waiting is not None])
        for task in tasks:
            task.seconds += (time.perf_counter() - started) / len(tasks)
        errors.update(zip(tasks, found, strict=True))
    return [(task, errors[task]) for task in waiting]


def _exception(error: BaseException) -> Exception:
    assert isinstance(error, Exception)
    return error


def _torch_numbers(torch: Any) -> Any:
    return None if torch is None else torch.get_rng_state()
