"""Peers in an environment of their own, since their dependencies conflict with ours.

`NAVIX_PYTHON`, `SBX_PYTHON` and `RL_ZOO_PYTHON` name a Python that has NAVIX, SBX (SB3 in JAX) or RL Zoo
(SB3's training scripts); docs/how-to/speed.md says how to make one. A peer without a Python is in the table
as not measured.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

from gridworld.base.errors import InputError

# NAVIX's own PPO on Empty-5x5, compiled; the second of two runs is timed, when nothing is left to compile.
_NAVIX = """
import sys, time, jax, jax.numpy as jnp, navix
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
seeds = int(sys.argv[1])
train = agent.train if seeds == 1 else jax.vmap(agent.train)
first = lambda part: jax.random.PRNGKey(part)
keys = first if seeds == 1 else lambda part: jax.random.split(first(part), seeds)
train = jax.jit(train).lower(keys(0)).compile()
for part in range(2):
    key = keys(part)
    started = time.perf_counter()
    state, _ = train(key)
    jax.block_until_ready(state.params)
    seconds = time.perf_counter() - started
print(seeds * settings.budget / seconds)
"""

# SBX's defaults on SB3's own batch of one-hot GridWorlds; again the second part is timed.
_SBX = """
import sys, time, gymnasium
import gridworld, sbx
from stable_baselines3.common.env_util import make_vec_env
algorithm, count = sys.argv[1], int(sys.argv[2])
wrapped = lambda: gridworld.OneHotObservation(gymnasium.make("GridWorld-v0"))
model = getattr(sbx, algorithm)("MlpPolicy", make_vec_env(wrapped, n_envs=count), seed=0)
model.learn(2048 * count)
started, before = time.perf_counter(), model.num_timesteps
model.learn(2048 * count, reset_num_timesteps=False)
print((model.num_timesteps - before) / (time.perf_counter() - started))
"""

_RL_ZOO_SETTINGS = Path(__file__).with_name("rl_zoo.yml")


def why_not(peer: str) -> str:
    """Why a peer (NAVIX, SBX or RL_ZOO) is not measured; "" where it is."""
    variable = _variable(peer)
    is_there = shutil.which(os.environ.get(variable, "")) is not None
    return "" if is_there else f"not measured, {variable} names no Python that has it"


def navix(seeds: int = 1) -> float:
    """Environment steps a second of NAVIX's PPO, 1024 environments x 32 steps, so many seeds at once."""
    return _run("NAVIX", _NAVIX, str(seeds))


def sbx(algorithm: str, num_envs: int) -> float:
    """Environment steps a second of SBX's PPO or DQN."""
    return _run("SBX", _SBX, algorithm, str(num_envs))


def rl_zoo(algorithm: str, steps: int) -> list[str]:
    """RL Zoo's command for GridWorld, to be run in `environment()`; it writes its logs where it runs.

    RL Zoo has no settings for an environment that it does not know, so its users write a file of them; ours
    names the observation and leaves the rest at SB3's defaults. One thread, as everywhere here: on all of two
    busy cores its PPO took six times as long.
    """
    words = ["--algo", algorithm, "--env", "GridWorld-v0", "--gym-packages", "gridworld"]
    words += ["--conf-file", str(_RL_ZOO_SETTINGS), "--n-timesteps", str(steps), "--num-threads", "1"]
    return [os.environ[_variable("RL_ZOO")], "-m", "rl_zoo3.train", *words, "--device", "cpu", "--seed", "0"]


def environment() -> dict[str, str]:
    """Environment variables by which a peer's Python finds this package, which is not installed there."""
    return {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}


def why(failed: subprocess.CompletedProcess[str]) -> str:
    """The last line that a process said, which failed."""
    return (failed.stderr.strip() or f"it ended with {failed.returncode}").splitlines()[-1]


def _variable(peer: str) -> str:
    return f"{peer}_PYTHON"


def _run(peer: str, script: str, *arguments: str) -> float:
    done = subprocess.run(
        [os.environ[_variable(peer)], "-c", script, *arguments],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=600,
    )
    if done.returncode:
        raise InputError(f"{_variable(peer)}={os.environ[_variable(peer)]}: {why(done)}")
    return float(done.stdout.split()[-1])
