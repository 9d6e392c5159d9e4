"""Several tasks in one thread that meet wherever one piece of work can be done for all of them at once.

Each task is an ordinary function, such as a whole training run, in a greenlet of its own. It runs undisturbed
until it calls `meet`; there it waits for the others, the work is done for all that wait with the same key,
and each goes on. A task that ends, or fails, is not waited for. Outside of `run_together`, `meet` does the
work for the one that calls it. So no task can tell whether it runs alone. A task may begin others, and wait
for them, by `run_together` itself: they meet all that run together with it.

What a process has only once is changed over with the task: the generators of random numbers (Python's,
numpy's and torch's) and the context variables. Only the second normal number that numpy's old functions keep
for the next call is not: to copy it takes longer than a step of training, none of which draws one.
"""

from __future__ import annotations

import contextlib
import contextvars
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np
from greenlet import getcurrent, greenlet

from gridworld.process.signals import stopped

T = TypeVar("T")
M = TypeVar("M")
LARGEST = 32  # runs that train together unless more are asked for; larger populations train no faster
_GLOBAL: Any = np.random  # numpy's stubs do not know all of its functions
Work = Callable[[Sequence[M]], Sequence[Exception | None]]
_is_by_itself: contextvars.ContextVar[bool] = contextvars.ContextVar("is_by_itself", default=False)
_mixed: contextvars.ContextVar[Mapping[str, str]] = contextvars.ContextVar(
    "mixed", default=MappingProxyType({})
)


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

    @property
    def can_go_on(self) -> bool:
        """Whether it waits for no work and no task that it began."""
        return self.waiting is None and not self.dead and all(task.dead for task in self.begun)

    def resume(self, error: BaseException | None = None) -> None:
        """Let it run, with its random numbers, until it waits again or has ended; raise `error` in it."""
        torch = sys.modules.get("torch")
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
            self._python, self._torch = random.getstate(), _torch_numbers()


def run_together(tasks: Sequence[Callable[[], T]]) -> list[T | Exception]:
    """Run tasks until all have ended.

    Args:
        tasks: they begin in this order.

    Returns:
        What each returned, or the exception that it raised.

    Raises:
        SystemExit: a task raised it. The others have gone on until they ended; those that had not begun
            were left out.
        BaseException: one of another kind, which is no `Exception`. It was raised in the others too, and none
            of them made a `SystemExit` of it.
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
        with _keeping_chance():
            _run_all(running)
    _exit_as_asked(own)
    return [task.result if task.error is None else _exception(task.error) for task in own]


def _run_all(running: list[_Task]) -> None:
    """Run tasks, and those that they begin, until all have ended and left the list."""
    exits: list[SystemExit] = []  # after the first, no other task begins

    def resume(task: _Task, error: BaseException | None = None) -> None:
        task.resume(error or stopped() or (exits[0] if exits and not task else None))
        if isinstance(task.error, SystemExit):
            exits.append(task.error)

    try:
        while running:
            for task in running:  # also those that are begun meanwhile
                if task.can_go_on:
                    resume(task)
                    _pass_on(task.error)
            for task, error in _met([task for task in running if task.waiting is not None]):
                resume(task, error)
                _pass_on(task.error)
            running[:] = [task for task in running if not task.dead]
    except BaseException as stop:
        for task in running:
            while not task.dead:  # it may wait once more on its way out
                resume(task, stop)
        if exits:
            raise exits[0] from None
        raise


def _pass_on(error: BaseException | None) -> None:
    """Raise what is to end all tasks."""
    if error is not None and not isinstance(error, Exception | SystemExit):
        raise error


@contextlib.contextmanager
def _keeping_chance() -> Iterator[None]:
    """Put the process's own generators back after the block."""
    bits, python, numbers = _GLOBAL.get_bit_generator(), random.getstate(), _torch_numbers()
    try:
        yield
    finally:
        _GLOBAL.set_bit_generator(bits)
        random.setstate(python)
        if numbers is not None:
            sys.modules["torch"].set_rng_state(numbers)


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
    if not isinstance(task, _Task) or _is_by_itself.get():
        (error,) = work([member])
        if error is not None:
            raise error
        return
    task.waiting = _Waiting(work, member, key)
    assert task.parent is not None
    task.parent.switch()


@contextlib.contextmanager
def by_itself() -> Iterator[None]:
    """Let no other task run in the block, which changes what all share: in there, `meet` waits for none."""
    token = _is_by_itself.set(True)
    try:
        yield
    finally:
        _is_by_itself.reset(token)


@contextlib.contextmanager
def mixing(runs: Mapping[str, str]) -> Iterator[None]:
    """Let the runs in the block be updated side by side even where their numbers then depend on each other.

    Args:
        runs: a hash of the settings of each by its folder's name, in their order; none: where their numbers
            are those of each alone.
    """
    token = _mixed.set(runs)
    try:
        yield
    finally:
        _mixed.reset(token)


def mixed() -> Mapping[str, str]:
    """The runs of `mixing`, this one among them; none outside of such a block."""
    return _mixed.get()


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
    """Do the work that most tasks wait for; returns what to raise in each of these, in their order.

    The others wait on. So tasks that are at different points of one loop come to do the same at once.
    """
    requests = [(task, task.waiting) for task in waiting if task.waiting is not None]
    if not requests:
        return []
    [(work, _)] = Counter(request.work for _, request in requests).most_common(1)
    groups: dict[Hashable, list[tuple[_Task, _Waiting[Any]]]] = {}
    for task, request in requests:
        if request.work == work:
            groups.setdefault(request.key, []).append((task, request))
    errors: dict[_Task, Exception | None] = {}
    for group in groups.values():
        started = time.perf_counter()
        found = work([request.member for _, request in group])
        for (task, _), error in zip(group, found, strict=True):
            task.seconds += (time.perf_counter() - started) / len(group)
            errors[task] = error
    return [(task, errors[task]) for task in waiting if task in errors]


def _exit_as_asked(ended: Sequence[_Task]) -> None:
    """Raise the first `SystemExit` that a task raised."""
    for task in ended:
        if isinstance(task.error, SystemExit):
            raise task.error


def _exception(error: BaseException) -> Exception:
    assert isinstance(error, Exception)
    return error


def _torch_numbers() -> Any:
    torch = sys.modules.get("torch")
    return None if torch is None else torch.get_rng_state()
