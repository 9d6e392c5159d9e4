"""Trains one agent with one library's own code, and reads its greedy policy while it learns.

It runs in that library's Python, a process for each row, and needs nothing of this package but for `engine`.
It reads a job as JSON and writes a line of it, {"step": 1000, "actions": [...]}, for each point of the curve.
`gym.make("Atlas-v0")` makes the job's tables an environment, with one-hot observations. It reads the policy
in every N-th step, before the update after it, as the engine's curve does; a library's loop is untouched.
"""

import importlib
import json
import math
import os
import sys
import tempfile
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
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
            self.write(
                step=min(self.count, self._steps),
                actions=np.asarray(self.greedy(self.rows)).reshape(-1).tolist(),
            )

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


def epsilon(job: dict[str, Any], step: int) -> Any:
    s = job["settings"]
    first, last = s["exploration_initial_eps"], s["exploration_final_eps"]
    return first + min(step / job["steps"] / s["exploration_fraction"], 1.0) * (last - first)


def plain(job: dict[str, Any], reader: Reader) -> None:
    """The textbook's Q-learning (Sutton and Barto, 2nd ed., section 6.5) in one environment."""
    s, rng, env = job["settings"], np.random.default_rng(reader.seed), gym.make("Atlas-v0")
    q = np.full((reader.rows.shape[1], len(job["world"]["next_state"][0])), s["initial_value"])
    reader.greedy = lambda rows: q[rows.argmax(axis=1)].argmax(axis=1)
    state = env.reset(seed=reader.seed)[0].argmax()
    for step in range(job["steps"]):
        greedy = rng.choice(np.flatnonzero(q[state] == q[state].max()))
        action = rng.integers(len(q[state])) if rng.random() < epsilon(job, step) else greedy
        observation, reward, terminated, truncated, _ = env.step(action)
        reached = observation.argmax()
        target = reward + s["gamma"] * q[reached].max() * (not terminated)
        q[state, action] += s["learning_rate"] * (target - q[state, action])
        state = env.reset()[0].argmax() if terminated or truncated else reached


def of_torch(reader: Reader, network: Callable[[], Any], scores: Any = lambda net, rows: net(rows)) -> Saved:
    """Read the action with the highest score of a network."""
    import torch

    def greedy(rows: np.ndarray) -> Any:
        with torch.no_grad():
            return scores(network(), torch.tensor(rows)).argmax(dim=1).numpy()

    def saved(path: str) -> Greedy:
        torch.save(network().state_dict(), path)
        for parameter in network().parameters():
            parameter.data.zero_()
        network().load_state_dict(torch.load(path))
        return greedy

    reader.greedy = greedy
    return saved


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

    saved = of_torch(reader, network)
    sys.path.insert(0, str(source))
    exec(compile(script.read_text("utf-8").replace(*change), str(script), "exec"), space)
    return saved


def orthogonal(network: Any, last: float) -> Any:
    """First weights as Stable-Baselines3's PPO has them, which these libraries leave to their users."""
    from torch import nn

    layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, last if layer is layers[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    return network


def tianshou(job: dict[str, Any], reader: Reader) -> Saved:
    """Tianshou's algorithms in its own trainers."""
    import torch
    from tianshou import algorithm, data, env, trainer
    from tianshou.algorithm import modelfree, optim
    from tianshou.utils.net import common, discrete

    s = SimpleNamespace(**{"n_envs": 1, "learning_starts": 0} | job["settings"])
    np.random.seed(reader.seed)
    torch.manual_seed(reader.seed)
    envs = env.DummyVectorEnv([lambda: gym.make("Atlas-v0")] * s.n_envs)
    envs.seed(reader.seed)
    space, shape = envs.action_space[0], {"state_shape": reader.rows.shape[1], "hidden_sizes": s.net_arch}
    if job["algorithm"] == "dqn":
        network, adam = common.Net(**shape, action_shape=space.n), optim.AdamOptimizerFactory(s.learning_rate)
        policy = modelfree.dqn.DiscreteQLearningPolicy(model=network, action_space=space)
        own = {"gamma": s.gamma, "target_update_freq": s.target_update_interval // s.train_freq}
        learner = algorithm.DQN(policy=policy, optim=adam, is_double=False, huber_loss_delta=1.0, **own)
        params, size, frames = trainer.OffPolicyTrainerParams, s.buffer_size, s.train_freq
        run = {"training_fn": lambda _, step: policy.set_eps_training(epsilon(job, step + s.learning_starts))}
        run |= {"update_step_num_gradient_steps_per_sample": 1 / frames}
    else:
        bodies = [common.Net(**shape, activation=torch.nn.Tanh) for _ in range(2)]
        network = discrete.DiscreteActor(preprocess_net=bodies[0], action_shape=space.n, softmax_output=False)
        critic = orthogonal(discrete.DiscreteCritic(preprocess_net=bodies[1]), 1.0)
        policy = modelfree.reinforce.DiscreteActorPolicy(actor=orthogonal(network, 0.01), action_space=space)
        adam = optim.AdamOptimizerFactory(s.learning_rate, eps=1e-5)
        own = {"gamma": s.gamma, "gae_lambda": s.gae_lambda, "max_grad_norm": s.max_grad_norm}
        own |= {"eps_clip": s.clip_range, "ent_coef": s.ent_coef, "vf_coef": s.vf_coef}
        learner = algorithm.PPO(policy=policy, critic=critic, optim=adam, **own)
        params, size = trainer.OnPolicyTrainerParams, s.n_steps * s.n_envs
        run, frames = {"update_step_num_repetitions": s.n_epochs}, size
    saved = of_torch(reader, lambda: network, lambda net, rows: net(rows)[0])
    collector = data.Collector(learner, envs, data.VectorReplayBuffer(size, s.n_envs), exploration_noise=True)
    collector.reset()
    if s.learning_starts:
        collector.collect(n_step=s.learning_starts, random=True)
    run |= {"epoch_num_steps": job["steps"] - s.learning_starts, "collection_step_num_env_steps": frames}
    run |= {"training_collector": collector, "max_epochs": 1, "show_progress": False, "verbose": False}
    learner.run_training(params(batch_size=s.batch_size, **run))
    return saved


def torchrl(job: dict[str, Any], reader: Reader) -> Saved:
    """TorchRL's losses and collector in its own trainers."""
    import torch
    from tensordict.nn import TensorDictModule, TensorDictSequential
    from torchrl import collectors, data, envs, modules, objectives
    from torchrl.trainers import algorithms

    s = SimpleNamespace(**{"n_envs": 1, "learning_starts": None, "max_grad_norm": 10.0} | job["settings"])
    torch.manual_seed(reader.seed)
    many = envs.SerialEnv(s.n_envs, lambda: envs.GymEnv("Atlas-v0", categorical_action_encoding=True))
    many.set_seed(reader.seed)
    spec, shape = many.action_spec_unbatched, {"in_features": reader.rows.shape[1], "num_cells": s.net_arch}
    if job["algorithm"] == "dqn":
        network = modules.MLP(**shape, out_features=spec.n, activation_class=torch.nn.ReLU)
        actor = modules.QValueActor(network, spec=spec, action_space="categorical")
        loss = objectives.DQNLoss(actor, loss_function="smooth_l1", action_space="categorical")
        loss.make_value_estimator(gamma=s.gamma)
        often = s.target_update_interval // s.train_freq - 1  # it copies in every (N + 1)-st update
        target = objectives.HardUpdate(loss, value_network_update_interval=often)
        annealing = s.exploration_initial_eps, s.exploration_final_eps, job["steps"] * s.exploration_fraction
        noise = modules.EGreedyModule(spec, *annealing)
        policy, sampler, adam_eps = TensorDictSequential(actor, noise), data.RandomSampler(), 1e-8
        own = {"target_net_updater": target, "greedy_module": noise, "optim_steps_per_batch": 1}
        trainer, size, frames = algorithms.DQNTrainer, s.buffer_size, s.train_freq
    else:
        nets = [modules.MLP(**shape, out_features=n, activation_class=torch.nn.Tanh) for n in (spec.n, 1)]
        network, critic = orthogonal(nets[0], 0.01), modules.ValueOperator(orthogonal(nets[1], 1.0))
        logits = TensorDictModule(network, ["observation"], ["logits"])
        kind = {"distribution_class": torch.distributions.Categorical, "return_log_prob": True}
        policy = modules.ProbabilisticActor(logits, ["logits"], spec=spec, **kind)
        own = {"clip_epsilon": s.clip_range, "entropy_coeff": s.ent_coef, "critic_coeff": s.vf_coef}
        loss = objectives.ClipPPOLoss(policy, critic, loss_critic_type="l2", normalize_advantage=True, **own)
        gae = objectives.value.GAE(gamma=s.gamma, lmbda=s.gae_lambda, value_network=critic)
        own = {"gae": gae, "num_epochs": s.n_epochs, "optim_steps_per_batch": None}
        trainer, size, frames = algorithms.PPOTrainer, s.n_steps * s.n_envs, s.n_steps * s.n_envs
        sampler, adam_eps = data.SamplerWithoutReplacement(), 1e-5
    saved = of_torch(reader, lambda: network)
    take = {"frames_per_batch": frames, "total_frames": job["steps"], "init_random_frames": s.learning_starts}
    storage = {"storage": data.LazyTensorStorage(size), "sampler": sampler, "batch_size": s.batch_size}
    own |= {"replay_buffer": data.TensorDictReplayBuffer(**storage), "loss_module": loss, "frame_skip": 1}
    own |= {"optimizer": torch.optim.Adam(loss.parameters(), lr=s.learning_rate, eps=adam_eps)}
    own |= {"collector": collectors.Collector(many, policy, **take), "total_frames": job["steps"]}
    trainer(**own, clip_norm=s.max_grad_norm, progress_bar=False, enable_logging=False).train()
    return saved


def rllib(job: dict[str, Any], reader: Reader) -> Saved:
    """RLlib's algorithms on its new API stack, all in this process."""
    from ray.rllib.algorithms import dqn, ppo

    s = SimpleNamespace(**{"n_envs": 1, "train_freq": "auto"} | job["settings"])
    if job["algorithm"] == "dqn":
        config, (ask, key), net = dqn.DQNConfig(), ("compute_q_values", "qf_preds"), {}
        own = {"train_batch_size_per_learner": s.batch_size, "grad_clip": 10.0, "double_q": False}
        own |= {"target_network_update_freq": s.target_update_interval, "tau": s.tau, "dueling": False}
        own |= {"num_steps_sampled_before_learning_starts": s.learning_starts}
        own |= {"epsilon": [(step, epsilon(job, step)) for step in (0, job["steps"])]}
        own |= {"replay_buffer_config": {"type": "EpisodeReplayBuffer", "capacity": s.buffer_size}}
    else:
        config, (ask, key) = ppo.PPOConfig(), ("forward_inference", "action_dist_inputs")
        net = {"fcnet_kernel_initializer": "orthogonal_", "fcnet_kernel_initializer_kwargs": {"gain": 2**0.5}}
        own = {"train_batch_size_per_learner": s.n_steps * s.n_envs, "minibatch_size": s.batch_size}
        own |= {"lambda_": s.gae_lambda, "clip_param": s.clip_range, "entropy_coeff": s.ent_coef}
        own |= {"vf_loss_coeff": s.vf_coef, "num_epochs": s.n_epochs, "grad_clip": s.max_grad_norm}
        own |= {"use_kl_loss": False, "vf_clip_param": math.inf}
        net["vf_share_layers"] = False
    net |= {"fcnet_activation": "tanh" if net else "relu", "fcnet_hiddens": s.net_arch}
    config.environment("Atlas-v0", disable_env_checking=True).rl_module(model_config=net)
    config.training(lr=s.learning_rate, gamma=s.gamma, grad_clip_by="global_norm", **own)
    collect = {"num_envs_per_env_runner": s.n_envs, "rollout_fragment_length": s.train_freq}
    learner = config.env_runners(num_env_runners=0, **collect).debugging(seed=reader.seed).build_algo()
    if job["algorithm"] == "dqn":
        learner.local_replay_buffer.rng = np.random.default_rng(reader.seed)  # has no seed of its own
    saved = of_torch(reader, learner.get_module, lambda net, rows: getattr(net, ask)({"obs": rows})[key])
    while reader.count < job["steps"]:
        learner.train()
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
