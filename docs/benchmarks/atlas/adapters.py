"""Trains one agent with one library's own code, and reads its greedy policy while it learns.

It runs in that library's Python, a process for each row, and needs nothing of this package but for `engine`.
It reads a job as JSON and writes a line of it, {"step": 1000, "actions": [...]}, for each point of the curve.
`gym.make("Atlas-v0")` makes the job's tables an environment, with one-hot observations. It reads the policy
in every N-th step, before the update after it, as the engine's curve does; a library's loop is untouched.
"""

import importlib
import json
import os
import sys
import tempfile
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

Greedy = Callable[[np.ndarray], Any]  # observations (n, N) to actions (n,); a Saved makes one of a path
Saved = Callable[[str], Greedy]


class Reader:
    """Counts the steps of all environments together, and writes the policy when it is due."""

    def __init__(self, job: dict[str, Any], out: Any) -> None:
        self._every, self._steps, self._out, self.seed = job["every"], job["steps"], out, job["seeds"][0]
        self.rows = np.array(job["world"]["observation"], dtype=np.float32)
        self.count = 0
        self.greedy: Greedy | None = None  # set by an adapter, before the first step

    def step(self) -> None:
        """Read the policy where it is due, before a library learns from this step; the last one after all."""
        if self.count == 0:
            self.read()
        self.count += 1
        if self.count % self._every == 0 and self.count < self._steps:
            self.read()

    def read(self) -> None:
        if self.greedy is not None:
            self.write(step=self.count, actions=np.asarray(self.greedy(self.rows)).reshape(-1).tolist())

    def write(self, **line: Any) -> None:
        print(json.dumps({"seed": self.seed, **line}), file=self._out, flush=True)


class TableEnv(gym.Env):
    """A world as tables, see `gridworld.world.mdp.Mdp`."""

    def __init__(self, world: dict[str, Any], reader: Reader) -> None:
        self._world, self._reader, self._state = world, reader, 0
        self._outcomes = np.cumsum(world["probability"], axis=2)[:, :, :-1].tolist()
        self._starts = np.cumsum(world["start"])[:-1].tolist()
        self.observation_space = gym.spaces.Box(0.0, 1.0, reader.rows.shape[1:], np.float32)
        self.action_space = gym.spaces.Discrete(len(world["next_state"][0]))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._state = bisect_right(self._starts, self.np_random.random())
        return self._reader.rows[self._state].copy(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._reader.step()
        state, action = self._state, int(action)
        outcome = bisect_right(self._outcomes[state][action], self.np_random.random())
        self._state = self._world["next_state"][state][action][outcome]
        reward, is_over = self._world["reward"][state][action][outcome], self._world["terminal"][self._state]
        return self._reader.rows[self._state].copy(), reward, is_over, False, {}


def plain(job: dict[str, Any], reader: Reader) -> None:
    """The textbook's Q-learning (Sutton and Barto, 2nd ed., section 6.5) in one environment."""
    s, rng, env = job["settings"], np.random.default_rng(reader.seed), gym.make("Atlas-v0")
    q = np.full((reader.rows.shape[1], int(env.action_space.n)), s["initial_value"])
    reader.greedy = lambda rows: q[rows.argmax(axis=1)].argmax(axis=1)
    first, last = s["exploration_initial_eps"], s["exploration_final_eps"]
    state = env.reset(seed=reader.seed)[0].argmax()
    for step in range(job["steps"]):
        epsilon = first + min(step / job["steps"] / s["exploration_fraction"], 1.0) * (last - first)
        greedy = rng.choice(np.flatnonzero(q[state] == q[state].max()))
        action = rng.integers(len(q[state])) if rng.random() < epsilon else greedy
        observation, reward, terminated, truncated, _ = env.step(action)
        reached = observation.argmax()
        target = reward + s["gamma"] * q[reached].max() * (not terminated)
        q[state, action] += s["learning_rate"] * (target - q[state, action])
        state = env.reset()[0].argmax() if terminated or truncated else reached


def sb3(job: dict[str, Any], reader: Reader) -> Saved:
    """Stable-Baselines3 and SBX, which has its interface, in their own loop."""
    from stable_baselines3.common.env_util import make_vec_env

    module = importlib.import_module({"sb3": "stable_baselines3", "sbx": "sbx"}[job["library"]])
    kind, settings = getattr(module, job["algorithm"].upper()), job["settings"]
    envs = make_vec_env("Atlas-v0", n_envs=settings.pop("n_envs", 1))
    model = kind("MlpPolicy", envs, seed=reader.seed, device="cpu", **settings)

    def greedy_of(some: Any) -> Greedy:
        return lambda rows: some.predict(rows, deterministic=True)[0]

    reader.greedy = greedy_of(model)
    model.learn(job["steps"])
    return lambda path: model.save(path) or greedy_of(kind.load(path, device="cpu"))


sbx = sb3


def cleanrl(job: dict[str, Any], reader: Reader) -> Saved:
    """CleanRL's script as it is, executed with arguments of its own; its network is found by its name."""
    import torch

    source = Path(job["room"], "cleanrl", "source")
    script, change = source / "cleanrl" / f"{job['algorithm']}.py", job["settings"].pop("change", ("", ""))
    fixed = {"env_id": "Atlas-v0", "seed": reader.seed, "total_timesteps": job["steps"], "cuda": False}
    sys.argv = [script.name]
    for name, value in {**fixed, **job["settings"]}.items():
        word = name.replace("_", "-")
        sys.argv += [f"--no-{word}"] if value is False else [f"--{word}", str(value)]
    space: dict[str, Any] = {"__name__": "__main__", "__file__": str(script)}

    def network() -> Any:
        return space["q_network"] if job["algorithm"] == "dqn" else space["agent"].actor

    def greedy(rows: np.ndarray) -> Any:
        with torch.no_grad():
            return network()(torch.tensor(rows)).argmax(dim=1).numpy()

    def saved(path: str) -> Greedy:
        torch.save(network().state_dict(), path)
        for parameter in network().parameters():
            parameter.data.zero_()
        network().load_state_dict(torch.load(path))
        return greedy

    reader.greedy = greedy
    sys.path.insert(0, str(source))
    exec(compile(script.read_text("utf-8").replace(*change), str(script), "exec"), space)
    return saved


def engine(job: dict[str, Any], reader: Reader) -> None:
    """This package, all seeds as one population: its learning curve is exact already."""
    import gridworld

    words = [*job["words"], f"total_timesteps={job['steps']}", f"evaluation.every={job['every']}"]
    sweep = gridworld.sweep(*words, "hydra.launcher.n_jobs=1", seed=job["seeds"], progress=False)
    for run in sweep.runs:
        reader.seed = run.summary["seed"]
        for step, regret, certified in zip(*map(run.curve.get, ("step", "regret", "certified")), strict=True):
            reader.write(step=int(step), regret=float(regret), certified=bool(certified))
        if job.get("diagnose") and not run.summary["certified"]:
            reader.write(cause=gridworld.diagnose(run).cause)


def play(what: dict[str, Any], greedy: Greedy) -> dict[str, float]:
    """The mean return of a policy, and its standard error, in an environment of Gymnasium itself."""
    env, returns = gym.make(what["id"]), []
    actions = np.asarray(greedy(np.eye(int(env.observation_space.n), dtype=np.float32)))
    for episode in range(what["episodes"]):
        state, total, is_over = env.reset(seed=episode)[0], 0.0, False
        while not is_over:
            state, reward, terminated, truncated, _ = env.step(int(actions[state]))
            total, is_over = total + float(reward), terminated or truncated
        returns.append(total)
    return {"played": float(np.mean(returns)), "error": float(np.std(returns, ddof=1) / len(returns) ** 0.5)}


def main() -> None:
    """One job, from standard input to standard output, on which a library may not print."""
    job, out = json.load(sys.stdin), sys.stdout
    job["world"] = json.loads(job["world"])
    sys.stdout, reader = sys.stderr, Reader(job, out)
    make: Any = lambda: TableEnv(job["world"], reader)  # noqa: E731
    gym.register("Atlas-v0", make, max_episode_steps=job["world"]["limit"], disable_env_checker=True)
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)  # where CleanRL writes runs/
        saved = globals()[job["library"]](job, reader)
        reader.read()
        if "play" in job and saved is not None:
            reader.write(**play(job["play"], saved(f"{place}/model")))


if __name__ == "__main__":
    main()
