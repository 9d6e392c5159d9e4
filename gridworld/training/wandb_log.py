"""A run in Weights & Biases while it trains.

Whether it is uploaded, and where to, W&B's own variables say: WANDB_MODE, WANDB_PROJECT, WANDB_ENTITY, ...
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import wandb

from gridworld.base.errors import InputError, in_short
from gridworld.base.safe_read import sha256
from gridworld.config.train import TrainConfig
from gridworld.training.tensorboard import hparams


def begin(config: TrainConfig, identity: Sequence[object], is_resumed: bool) -> Any:
    """Begin a run of W&B, or continue the one of this identity."""
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
    group = f"{config.agent.name}-{config.env.name}"
    try:
        run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "gridworld"),
            group=group,
            name=f"{group}-seed{config.seed}",
            id=sha256(repr(identity).encode())[:16],
            resume="allow" if is_resumed else None,
            config=hparams(config),
            # Runs may train together. A callback of W&B's takes the one that is the process's.
            reinit="finish_previous" if config.callbacks else "create_new",
            settings=wandb.Settings(silent=not config.logging.progress),
        )
    except wandb.Error as error:
        why = f"{in_short(error)}; WANDB_MODE=offline needs no account"
        raise InputError(f"logging.wandb=true: {why}") from None
    run.define_metric("*", step_metric="step")
    return run
