"""scripts/train.py in a process that is killed right after its n-th checkpoint: dying.py N WORDS..."""

import os
import signal
import sys
from typing import Any

from gridworld.commands import call
from gridworld.run.checkpoints import Checkpoints

save, left = Checkpoints.save, int(sys.argv.pop(1))


def dying(*arguments: Any, **options: Any) -> None:
    global left
    save(*arguments, **options)
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)


Checkpoints.save = dying  # type: ignore[method-assign]
call("train")
