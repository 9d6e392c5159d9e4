"""Signal handling: SIGINT is Ctrl-C, and SIGTERM is how a scheduler says that a machine is wanted back.

While the package is imported, either ends the process at once (`listen`). In a command, either raises an
exception, so that the command cleans up (`at_work`). In training, either asks for a checkpoint first
(`StopRequest`).
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType
from typing import Any, ClassVar


class Interrupted(BaseException):
    """Training was asked to stop; the run's files are closed and say so."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(f"stopped by {signal_name(signal_number)}")
        self.exit_code = 128 + signal_number  # as shells have it


def signal_name(number: int) -> str:
    """The name of a signal, e.g. "SIGTERM"."""
    return signal.Signals(number).name


def listen() -> None:
    """Let Ctrl-C end the process at once and without a traceback, as SIGTERM does."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a shell's background job ignores it
        signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def at_work() -> Iterator[None]:
    """Let SIGINT raise `KeyboardInterrupt`, and SIGTERM `SystemExit`, which is told."""
    ctrl_c = {signal.SIGINT: signal.default_int_handler}
    with (
        exiting(signal.SIGTERM, first=lambda number: os.write(2, b"stopped by SIGTERM\n")),
        handling(ctrl_c if signal.getsignal(signal.SIGINT) is signal.SIG_DFL else {}),
    ):
        yield


@contextmanager
def handling(handlers: Mapping[signal.Signals, Any]) -> Iterator[None]:
    """Install handlers for the block, and put those back that were there before. For the main thread."""
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def exiting(*numbers: signal.Signals, first: Callable[[int], object] = int) -> Iterator[None]:
    """Let these signals call `first` and raise `SystemExit` with 128 + their number. For the main thread."""

    def stop(number: int, frame: FrameType | None) -> None:
        first(number)
        raise SystemExit(128 + number)

    with handling(dict.fromkeys(numbers, stop)):
        yield


@contextmanager
def deferring(*numbers: signal.Signals) -> Iterator[None]:
    """Call the handlers of these signals only after the block. Other threads than the main one call none."""
    received: list[int] = []
    own = [number for number in numbers if signal.getsignal(number) is not None]  # None: not Python's
    if threading.current_thread() is not threading.main_thread():
        own = []
    try:
        with handling(dict.fromkeys(own, lambda number, frame: received.append(number))):
            yield
    finally:
        for number in received:
            signal.raise_signal(number)


@contextmanager
def blocking(*numbers: signal.Signals) -> Iterator[None]:
    """Deliver these signals to this thread only after the block; a process started in it never gets them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def send_sigterm(number: int = 0, frame: FrameType | None = None) -> None:
    """Send SIGTERM to this process. May be a handler, so that another signal does what SIGTERM does."""
    os.kill(os.getpid(), signal.SIGTERM)


class StopRequest:
    """Whether SIGINT or SIGTERM has asked training to stop.

    Of trainings that run together (`training.together`) each has its own, and a signal asks all of them.

    Attributes:
        number: of the signal; None as long as there was none.
        patient: whether the training at work is left to come to a safe point. If not, and at a second signal,
            the handler raises `Interrupted` at once.
    """

    _listening: ClassVar[list[StopRequest]] = []
    _handlers: ClassVar[dict[int, Any]] = {}  # that were there before the first of them

    def __init__(self) -> None:
        self.number: int | None = None
        self.patient = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take the signals for the block. Outside the main thread, where none arrive, it does nothing.

        An interruption leaves it as `Interrupted`, also where a cleanup inside failed because of that.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        if self._listening:  # those that began before may have been asked already
            self.number = self._listening[0].number
        else:
            for each in (signal.SIGINT, signal.SIGTERM):
                self._handlers[each] = signal.signal(each, self._handle)
        self._listening.append(self)
        token = _running.set(self)
        try:
            yield
        except Exception as error:
            cause: BaseException | None = error  # `torch.save`, interrupted, fails to close its file
            while cause is not None and not isinstance(cause, Interrupted):
                cause = cause.__context__
            if cause is None:
                raise
            raise cause from None
        finally:
            _running.reset(token)
            self._listening.remove(self)
            if not self._listening:
                for number, handler in self._handlers.items():
                    signal.signal(number, handler)

    def obey(self) -> None:
        """Stop here, by `Interrupted`, if a signal asked for it; one that comes later stops at once."""
        self.patient = False
        if self.number is not None:
            raise Interrupted(self.number)

    @classmethod
    def _handle(cls, number: int, frame: FrameType | None) -> None:
        asked, running = cls._listening[0].number, _running.get()
        for request in cls._listening:
            request.number = number
        if asked is not None or (running is not None and not running.patient):
            raise Interrupted(number)


_running: ContextVar[StopRequest | None] = ContextVar("running", default=None)
