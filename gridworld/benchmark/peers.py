"""Peers that live in an environment of their own, since their dependencies would not go with ours.

`NAVIX_PYTHON` names a Python that has NAVIX: `python -m venv navix && navix/bin/pip install navix`, then
`NAVIX_PYTHON=navix/bin/python python scripts/benchmark.py`.
"""

from __future__ import annotations

import os
import subprocess

_VARIABLE = "NAVIX_PYTHON"

# NAVIX's own PPO, compiled; the second of two runs is timed, when nothing is left to compile.
_NAVIX = """
import time, jax, jax.numpy as jnp, navix
from navix import observations
from navix.agents import PPO, PPOHparams, ActorCritic
env = navix.make("Navix-Empty-5x5-v0", observation_fn=observations.symbolic, gamma=0.99)
look, space = env.observation_fn, env.observation_space
flat = lambda state: jnp.ravel(look(state)).astype(jnp.float32)
size = int(jnp.prod(jnp.asarray(space.shape)))
env = env.replace(observation_fn=flat, observation_space=space.replace(shape=(size,)))
settings = PPOHparams(
    budget=1024 * 32 * 16, num_envs=1024, num_steps=32, num_minibatches=4, num_epochs=4
)
agent = PPO(hparams=settings, network=ActorCritic(action_dim=len(env.action_set)), env=env)
train = jax.jit(agent.train).lower(jax.random.PRNGKey(0)).compile()
for seed in range(2):
    key = jax.random.PRNGKey(seed)
    started = time.perf_counter()
    state, _ = train(key)
    jax.block_until_ready(state.params)
    seconds = time.perf_counter() - started
print(settings.budget / seconds)
"""


def why_no_navix() -> str:
    """Why NAVIX is not measured, or nothing where it is."""
    if _VARIABLE in os.environ:
        return ""
    return f"not measured, {_VARIABLE} names no Python that has it (README, Speed)"


def navix_steps_per_second() -> float:
    """Environment steps a second of NAVIX's PPO on Empty-5x5, 1024 environments x 32 steps."""
    done = subprocess.run(
        [os.environ[_VARIABLE], "-c", _NAVIX], capture_output=True, text=True, check=True, timeout=600
    )
    return float(done.stdout.split()[-1])
