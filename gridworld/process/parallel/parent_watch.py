"""A worker process that does not outlive its parent."""

from __future__ import annotations

import os
import signal
import threading
import time

from gridworld.process.signals import send_sigterm

_SECONDS_BETWEEN_CHECKS = 0.2
_GRACE_SECONDS = 3.0  # to close the files

parent_died = threading.Event()


def end_with(parent: int) -> None:
    """End this process soon after its parent, even if that is killed: first by SIGTERM, then in any case.

    Ctrl-C is ignored: it reaches the parent too, which ends its workers.

    Args:
        parent: its process id.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_SECONDS_BETWEEN_CHECKS)
        parent_died.set()
        send_sigterm()
        time.sleep(_GRACE_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="watch on the parent").start()
