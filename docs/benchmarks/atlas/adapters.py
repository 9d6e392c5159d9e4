"""Trains one agent with one library's own code, and reads its greedy policy while it learns.

It runs in that library's Python, as a process for each row, and imports nothing of this package but for
`engine`. It reads a job as one line of JSON and writes lines: {"step": 1000, "actions": [...]}, one for each
point of the learning curve, and at the end {"seconds": 12.3}.

The world is a table that the job brings; `gym.make("Atlas-v0")` makes it, with the step limit as Gymnasium's own
wrapper and one-hot observations. Policies are read by the environment: before the step that follows every N
steps, it asks the library for its actions in all states, so the library's loop is as it was published. The
last policy is read after the last update.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import tempfile
import time
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

ENV_ID = "Atlas-v0"
Greedy = Callable[[np.ndarray], Any]  # observations (n, N) to actions (n,)


class Reader:
    """Counts the steps of all environments together, and writes the policy when it is due."""

    def __init__(self, job: dict[str, Any], out: Any) -> None:
        self._every, self._steps, self._out = job["every"], job["steps"], out
        self.rows = np.array(job["world"]["observation"], dtype=np.float32)
        self.count = 0
        self.greedy: Greedy | None = None  # set by an adapter, before the first step

    def before_step(self) -> None:
        """Read the policy where that many steps are done; the last one is left to `read`."""
        if self.count % self._every == 0 and self.count < self._steps and self.greedy is not None:
            self.read()
        self.count += 1

    def read(self) -> None:
        actions = np.asarray(self.greedy(self.rows)).reshape(-1)
        self.write(step=self.count, actions=actions.tolist())

    def write(self, **line: Any) -> None:
        print(json.dumps(line), file=self._out, flush=True)


class TableEnv(gym.Env):
    """A world as tables, see `gridworld.world.mdp.Mdp`."""

    def __init__(self, world: dict[str, Any], reader: Reader) -> None:
        self._reader, self._rows = reader, reader.rows
        self._next, self._reward = world["next_state"], world["reward"]
        self._outcomes = np.cumsum(np.array(world["probability"]), axis=2)[:, :, :-1].tolist()
        self._terminal = world["terminal"]
        self._starts = np.cumsum(world["start"])[:-1].tolist()
        self.observation_space = gym.spaces.Box(0.0, 1.0, self._rows.shape[1:], np.float32)
        self.action_space = gym.spaces.Discrete(len(self._next[0]))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._state = bisect_right(self._starts, self.np_random.random())
        return self._rows[self._state].copy(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._reader.before_step()
        state, action = self._state, int(action)
        outcome = bisect_right(self._outcomes[state][action], self.np_random.random())
        self._state = self._next[state][action][outcome]
        reward, over = self._reward[state][action][outcome], self._terminal[self._state]
        return self._rows[self._state].copy(), reward, over, False, {}


def plain_q_learning(job: dict[str, Any], reader: Reader) -> None:
    """The textbook's loop (Sutton and Barto, 2nd ed., section 6.5), one environment, a table of zeros."""
    s, rng = job["settings"], np.random.default_rng(job["seed"])
    env = gym.make(ENV_ID)
    q = np.full((reader.rows.shape[1], int(env.action_space.n)), s["initial_value"])
    reader.greedy = lambda rows: q[rows.argmax(axis=1)].argmax(axis=1)
    state, over = env.reset(seed=job["seed"])[0].argmax(), False
    for step in range(job["steps"]):
        part = min(step / job["steps"] / s["exploration_fraction"], 1.0)
        epsilon = s["exploration_initial_eps"] + part * (
            s["exploration_final_eps"] - s["exploration_initial_eps"]
        )
        best = np.flatnonzero(q[state] == q[state].max())
        greedy = rng.choice(best) if s["ties"] == "random" else best[0]
        action = rng.integers(len(q[state])) if rng.random() < epsilon else greedy
        observation, reward, terminated, truncated, _ = env.step(action)
        reached, over = observation.argmax(), terminated or truncated
        target = reward + s["gamma"] * q[reached].max() * (not terminated)
        q[state, action] += s["learning_rate"] * (target - q[state, action])
        state = env.reset()[0].argmax() if over else reached


def sb3_like(job: dict[str, Any], reader: Reader) -> None:
    """Stable-Baselines3 and SBX, which has its interface, in their own loop."""
    import torch
    from stable_baselines3.common.env_util import make_vec_env

    torch.set_num_threads(1)
    module = importlib.import_module({"sb3": "stable_baselines3", "sbx": "sbx"}[job["library"]])
    settings = dict(job["settings"])
    envs = make_vec_env(ENV_ID, n_envs=settings.pop("n_envs", 1))
    kind = getattr(module, job["algorithm"].upper())
    model = kind("MlpPolicy", envs, seed=job["seed"], device="cpu", **settings)
    reader.greedy = lambda rows: model.predict(rows, deterministic=True)[0]
    model.learn(job["steps"])
    if "play" in job:
        with tempfile.TemporaryDirectory() as folder:
            model.save(f"{folder}/model")
            saved = kind.load(f"{folder}/model", device="cpu")
        play(job["play"], reader, lambda rows: saved.predict(rows, deterministic=True)[0])


def cleanrl(job: dict[str, Any], reader: Reader) -> None:
    """CleanRL's script as it is, executed with its own arguments; its network is found by its name."""
    import torch

    torch.set_num_threads(1)
    folder = Path(job["source"])
    script = folder / "cleanrl" / f"{job['algorithm']}.py"
    sys.path.insert(0, str(folder))
    given = {
        "env_id": ENV_ID,
        "seed": job["seed"],
        "total_timesteps": job["steps"],
        **job["settings"],
    }
    words = [
        (f"--{'' if value is not False else 'no-'}{name}".replace("_", "-"), value)
        for name, value in given.items()
    ]
    sys.argv = [
        script.name,
        *(w for word, value in words for w in ([word] if isinstance(value, bool) else [word, str(value)])),
        "--no-cuda",
    ]
    space: dict[str, Any] = {"__name__": "__main__", "__file__": str(script)}

    def network() -> Any:
        return space["q_network"] if job["algorithm"] == "dqn" else space["agent"].actor

    def greedy(rows: np.ndarray) -> Any:
        with torch.no_grad():
            return network()(torch.tensor(rows)).argmax(dim=1).numpy()

    reader.greedy = greedy
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)  # it writes runs/
        exec(compile(script.read_text("utf-8"), str(script), "exec"), space)
        os.chdir(here)
        if "play" in job:
            torch.save(network().state_dict(), f"{place}/model.pt")
            saved = torch.load(f"{place}/model.pt")
            for parameter in network().parameters():
                parameter.data.zero_()
            network().load_state_dict(saved)
            play(job["play"], reader, greedy)


def engine(job: dict[str, Any], reader: Reader) -> None:
    """This package: its learning curve is exact already, and says why a policy is not optimal."""
    import gridworld

    quiet = ["logging.progress=false", f"total_timesteps={job['steps']}", f"evaluation.every={job['every']}"]
    run = gridworld.train(*job["words"], *quiet, seed=job["seed"])
    names = ("step", "regret", "certified")
    for step, regret, certified in zip(*(run.curve[name].tolist() for name in names), strict=True):
        reader.write(step=int(step), regret=regret, certified=bool(certified))
    if job.get("diagnose") and not run.summary["certified"]:
        reader.write(cause=gridworld.diagnose(run).cause)


def play(what: dict[str, Any], reader: Reader, greedy: Greedy) -> None:
    """Play a saved model in an environment of Gymnasium itself, which knows nothing of our tables."""
    env, returns = gym.make(what["id"]), []
    actions = np.asarray(greedy(np.eye(int(env.observation_space.n), dtype=np.float32)))
    for episode in range(what["episodes"]):
        state, total, over = env.reset(seed=episode)[0], 0.0, False
        while not over:
            state, reward, terminated, truncated, _ = env.step(int(actions[state]))
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    error = float(np.std(returns, ddof=1) / np.sqrt(len(returns)))
    reader.write(played=float(np.mean(returns)), error=error)


ADAPTERS = {"sb3": sb3_like, "sbx": sb3_like, "cleanrl": cleanrl, "engine": engine, "plain": plain_q_learning}


def main() -> None:
    """One job, from standard input to standard output, on which a library may not print."""
    job, out = json.loads(sys.stdin.readline()), sys.stdout
    sys.stdout = sys.stderr
    reader = Reader(job, out)
    limit = job["world"]["limit"]
    gym.register(
        ENV_ID,
        entry_point=lambda **_: TableEnv(job["world"], reader),
        max_episode_steps=limit,
        disable_env_checker=True,
    )
    started = time.perf_counter()
    ADAPTERS[job["library"]](job, reader)
    if reader.greedy is not None:
        reader.read()
    reader.write(seconds=time.perf_counter() - started)


if __name__ == "__main__":
    main()
