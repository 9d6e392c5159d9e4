"""Signal handling while a command is at work. Every handler is installed by a function of this module.

SIGINT is Ctrl-C; SIGTERM is how a scheduler says that a machine is wanted back. `early_signals` handles both
until training, a search or a sweep has begun, and imports less than this module does.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType

Handler = Callable[[int, FrameType | None], None]

_SECONDS_TO_SAFE_POINT = 1.0  # training may go on for so long to come to where it can be saved


_HAS_ALARM = hasattr(signal, "setitimer")  # Windows has none: training goes on to where it can be saved


class Interrupted(BaseException):
    """Training was asked to stop; the run's files are closed and say so.

    Attributes:
        exit_code: 128 + the signal's number, as shells have it.
    """

    def __init__(self, signal_number: int) -> None:
        super().__init__(f"stopped by {signal_name(signal_number)}")
        self.exit_code = 128 + signal_number


def signal_name(number: int) -> str:
    """The name of a signal, e.g. "SIGTERM"."""
    return signal.Signals(number).name


@contextmanager
def handling(handlers: Mapping[signal.Signals, Handler]) -> Iterator[None]:
    """Install handlers for the block, and put those back that were there before. For the main thread."""
    with keeping(*handlers):
        for number, handler in handlers.items():
            signal.signal(number, handler)
        yield


@contextmanager
def keeping(*numbers: signal.Signals) -> Iterator[None]:
    """Put these signals' handlers back after the block, should it replace them. For the main thread."""
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def exiting(*numbers: signal.Signals, first: Callable[[int], None] | None = None) -> Iterator[None]:
    """Let these signals raise `SystemExit` with 128 + their number in the block. For the main thread.

    Args:
        numbers: of the signals.
        first: is called with the signal's number before that.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        if first is not None:
            first(number)
        raise SystemExit(128 + number)

    with handling(dict.fromkeys(numbers, stop)):
        yield


@contextmanager
def blocking(*numbers: signal.Signals) -> Iterator[None]:
    """Deliver these signals to this thread only after the block; a process started in it never gets them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore(number: signal.Signals) -> None:
    """Ignore a signal from here on."""
    signal.signal(number, signal.SIG_IGN)


def set_on(number: signal.Signals, event: threading.Event) -> None:
    """Let a signal set an event from here on, and do nothing else."""
    signal.signal(number, lambda number, frame: event.set())


def send_sigterm(number: int = 0, frame: FrameType | None = None) -> None:
    """Send SIGTERM to this process. May be a handler, so that another signal does what SIGTERM does."""
    if sys.platform == "win32":
        signal.raise_signal(signal.SIGTERM)  # `os.kill` would end the process there
    else:
        os.kill(os.getpid(), signal.SIGTERM)


def relay(number: int, times: int, process: int) -> None:
    """Have another process, which has called `obey_relay`, take a signal as often as this one did.

    Args:
        number: SIGINT or SIGTERM.
        times: how many of both have come here so far, 1 or 2.
        process: its id.
    """
    os.kill(process, _relayed(number, times))


def obey_relay() -> None:
    """From here on, exit with 128 + their number at SIGINT and SIGTERM, and take those that are relayed.

    A terminal sends Ctrl-C to all of its processes, `kill` to one. So one that is relayed is left alone where
    as many have come here by themselves. For the main thread of a process that has nothing to clean up.
    """
    _received.clear()

    def stop(number: int, frame: FrameType | None) -> None:
        _received.append(number)
        raise SystemExit(128 + number)

    def take(relayed: int, frame: FrameType | None) -> None:
        times, which = divmod(relayed - signal.SIGRTMIN, len(_RELAYED))
        if len(_received) < times:
            signal.raise_signal(_RELAYED[which])

    for number in _RELAYED:
        signal.signal(number, stop)
        for times in (1, 2):
            signal.signal(_relayed(number, times), take)


def _relayed(number: int, times: int) -> int:
    """The signal that stands for a relayed one; Python handles it after those that it stands for."""
    return signal.SIGRTMIN + len(_RELAYED) * times + _RELAYED.index(signal.Signals(number))


_RELAYED = (signal.SIGINT, signal.SIGTERM)
_received: list[int] = []  # of these, by this process, once it has called `obey_relay`


def _set_alarm(seconds: float) -> None:
    """Send SIGALRM to this process after so many seconds, 0 for never, where there is such a signal."""
    if _HAS_ALARM:
        signal.setitimer(signal.ITIMER_REAL, seconds)


class StopRequest:
    """Whether SIGINT or SIGTERM has asked training to stop.

    Of trainings that run together (`training.together`) each has its own, and a signal asks all of them.

    Attributes:
        number: of the signal; None as long as there was none.
        patient: whether training is left a second to come to a safe point. If not, and at a second signal,
            the handler raises `Interrupted` at once.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.patient = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take the signals for the block. Outside the main thread, where none arrive, it does nothing.

        Raises:
            Interrupted: the block was interrupted, also where a cleanup inside it failed because of that.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        outer = _inside.get()
        if not _listeners or _listeners[-1].outer is not outer:
            _listeners.append(_Listeners(outer))
        listeners, token = _listeners[-1], _inside.set(self)
        listeners.add(self)
        try:
            yield
        except Exception as error:
            interruption = _interruption_behind(error)
            if interruption is None:
                raise
            raise interruption from None
        finally:
            _inside.reset(token)
            listeners.remove(self)

    def obey(self) -> None:
        """Stop here if a signal asked for it.

        Raises:
            Interrupted: one did.
        """
        if self.number is not None:
            raise Interrupted(self.number)

    def take_time(self) -> None:
        """Let what follows take longer than the second that a patient request leaves."""
        _set_alarm(0)


class _Listeners:
    """The requests of trainings that run together, inside the block of another one perhaps."""

    def __init__(self, outer: StopRequest | None) -> None:
        self.outer = outer
        self._requests: list[StopRequest] = []

    def add(self, request: StopRequest) -> None:
        if not self._requests:
            handlers = {signal.SIGINT: self._asked, signal.SIGTERM: self._asked}
            if _HAS_ALARM:
                handlers[signal.SIGALRM] = self._late
            self._before = {number: signal.getsignal(number) for number in handlers}
            for number, handler in handlers.items():
                signal.signal(number, handler)
        else:  # those that began before may have been asked already
            request.number = self._requests[0].number
        self._requests.append(request)

    def remove(self, request: StopRequest) -> None:
        self._requests.remove(request)
        if not self._requests:
            _set_alarm(0)
            for number, handler in self._before.items():
                signal.signal(number, handler)
            _listeners.remove(self)

    def _asked(self, number: int, frame: FrameType | None) -> None:
        _received.append(number)
        running = _inside.get()
        again = self._requests[0].number is not None
        for request in self._requests:
            request.number = number
        if again or (running in self._requests and not running.patient):
            raise Interrupted(number)
        _set_alarm(_SECONDS_TO_SAFE_POINT)

    def _late(self, number: int, frame: FrameType | None) -> None:
        asked = self._requests[0].number
        if asked is not None:
            raise Interrupted(asked)


def _interruption_behind(error: BaseException | None) -> Interrupted | None:
    """The interruption that an error came of: `torch.save`, interrupted, fails to close its file."""
    while error is not None and not isinstance(error, Interrupted):
        error = error.__context__
    return error


_inside: ContextVar[StopRequest | None] = ContextVar("inside", default=None)
_listeners: list[_Listeners] = []  # the innermost last
