"""Peers in an environment of their own, since their dependencies conflict with ours.

`NAVIX_PYTHON`, `SBX_PYTHON`, `RL_ZOO_PYTHON`, `ENVPOOL_PYTHON` and `MDPSOLVER_PYTHON` name a Python that has
NAVIX, SBX (SB3 in JAX), RL Zoo (SB3's training scripts), EnvPool (environments in C++ threads) or mdpsolver
(dynamic programming in C++); docs/how-to/speed.md says how to make one. A peer without a Python
is in the table as not measured.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from gridworld.base.errors import InputError
from gridworld.world.mdp import Mdp

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

_ENVPOOL = """
import sys, time, envpool, numpy
count, seconds = int(sys.argv[1]), float(sys.argv[2])
envs = envpool.make_gymnasium("FrozenLake-v1", num_envs=count, num_threads=2)
actions = numpy.random.default_rng(0).integers(4, size=(32, count), dtype=numpy.int32)
envs.reset()
steps, started = 0, time.perf_counter()
while time.perf_counter() - started < seconds:
    for batch in actions:
        envs.step(batch)
    steps += actions.size
print(steps / (time.perf_counter() - started))
"""

# Only the solving is timed, not the copying of the tables into lists.
_MDPSOLVER = """
import sys, time, numpy, mdpsolver
tables = numpy.load(sys.argv[1])
probability, next_state = tables["probability"], tables["next_state"]
rewards = (probability * tables["reward"]).sum(axis=2).tolist()
model = mdpsolver.model()
model.mdp(
    discount=0.99, rewards=rewards, tranMatProbs=probability.tolist(), tranMatColumns=next_state.tolist()
)
started = time.perf_counter()
model.solve(algorithm="mpi", tolerance=1e-9, verbose=False)
print(time.perf_counter() - started)
"""

_RL_ZOO_SETTINGS = Path(__file__).with_name("rl_zoo.yml")


def why_not(peer: str) -> str:
    """Why a peer (NAVIX, SBX, RL_ZOO, ENVPOOL or MDPSOLVER) is not measured; "" where it is."""
    variable = _variable(peer)
    is_there = shutil.which(os.environ.get(variable, "")) is not None
    return "" if is_there else f"not measured, {variable} names no Python that has it"


def navix(seeds: int = 1) -> float:
    """Environment steps a second of NAVIX's PPO, 1024 environments x 32 steps, so many seeds at once."""
    return _run("NAVIX", _NAVIX, str(seeds))


def sbx(algorithm: str, num_envs: int) -> float:
    """Environment steps a second of SBX's PPO or DQN."""
    return _run("SBX", _SBX, algorithm, str(num_envs))


def envpool(num_envs: int, seconds: float) -> float:
    """Environment steps a second of EnvPool's FrozenLake."""
    return _run("ENVPOOL", _ENVPOOL, str(num_envs), str(seconds))


def mdpsolver(mdp: Mdp) -> float:
    """Seconds in which mdpsolver solves a world, to 1e-9."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tables.npz"
        np.savez(path, probability=mdp.probability, next_state=mdp.next_state, reward=mdp.reward)
        return _run("MDPSOLVER", _MDPSOLVER, str(path))


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
