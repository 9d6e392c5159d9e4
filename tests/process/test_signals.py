"""What an interruption becomes on its way through other people's code."""

import io
import os
import signal
from typing import Any

import pytest
import torch

from gridworld.process.signals import Interrupted, StopRequest


class Interruptible(io.BytesIO):
    """A file that SIGTERM comes for once it has some bytes."""

    asked = False

    def write(self, data: Any) -> int:
        if self.tell() and not self.asked:
            self.asked = True
            os.kill(os.getpid(), signal.SIGTERM)
        return super().write(data)


def test_an_interruption_stays_one_where_a_cleanup_fails() -> None:
    """torch's writer, interrupted, raises an error of its own as it closes its file."""

    def save() -> None:
        with StopRequest().listening():
            torch.save({"weights": torch.zeros(100)}, Interruptible())

    with pytest.raises(Interrupted, match="stopped by SIGTERM"):
        save()


def test_another_failure_stays_what_it_is() -> None:
    def fail() -> None:
        with StopRequest().listening():
            try:
                raise KeyError("cause")
            except KeyError:
                raise ZeroDivisionError  # noqa: B904

    with pytest.raises(ZeroDivisionError) as caught:
        fail()
    assert isinstance(caught.value.__context__, KeyError)
    assert not caught.value.__suppress_context__
