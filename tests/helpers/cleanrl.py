"""The learners of CleanRL's dqn.py and ppo.py as train functions, with a place for a planted bug.

Adapted from https://github.com/vwxyzjn/cleanrl (commit fe8d8a03): the networks, the losses and the order of
the steps are theirs; what reads the command line, logs and saves is left out, and some settings are smaller.
PPO adds the value of the last state of a truncated episode to its reward; ppo.py does not (their issue 198).

MIT License

Copyright (c) 2019 CleanRL developers

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated
documentation files (the "Software"), to deal in the Software without restriction, including without
limitation the rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the
Software, and to permit persons to whom the Software is furnished to do so, subject to the following
conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial portions
of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED
TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL
THE AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF
CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER
DEALINGS IN THE SOFTWARE.
"""

import random
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import nn, optim
from torch.distributions.categorical import Categorical
from torch.nn import functional as F  # noqa: N812


def vector(env: gym.Env[Any, Any], seed: int) -> gym.vector.SyncVectorEnv:
    """As CleanRL has it, in Gymnasium 0.29: an environment is reset in the step that ends its episode."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    return gym.vector.SyncVectorEnv([lambda: env], autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)


def dqn(
    env: gym.Env[Any, Any], total_timesteps: int, seed: int, gamma: float = 0.99, bug: str = ""
) -> dict[str, Any]:
    """dqn.py. Bugs: dones, target, next."""
    learning_rate, buffer_size, batch_size, learning_starts = 2e-3, 10_000, 128, 200
    train_frequency, target_network_frequency = 2, 100
    start_e, end_e, exploration_fraction = 1.0, 0.05, 0.5
    envs = vector(env, seed)
    inputs, outputs = env.observation_space.shape[0], int(env.action_space.n)  # type: ignore

    def network() -> nn.Sequential:
        layers = (nn.Linear(inputs, 120), nn.ReLU(), nn.Linear(120, 84), nn.ReLU(), nn.Linear(84, outputs))
        return nn.Sequential(*layers)

    q_network, target_network = network(), network()
    optimizer = optim.Adam(q_network.parameters(), lr=learning_rate)
    target_network.load_state_dict(q_network.state_dict())
    replay = [
        *(np.zeros((buffer_size, inputs), np.float32) for _ in range(2)),
        *(np.zeros((buffer_size, 1), kind) for kind in (np.int64, np.float32, np.float32)),
    ]

    obs, _ = envs.reset(seed=seed)
    for global_step in range(total_timesteps):
        slope = (end_e - start_e) / (exploration_fraction * total_timesteps)
        epsilon = max(slope * global_step + start_e, end_e)
        if random.random() < epsilon:
            actions = np.array([envs.single_action_space.sample()])
        else:
            with torch.no_grad():
                actions = torch.argmax(q_network(torch.Tensor(obs)), dim=1).numpy()
        next_obs, rewards, terminations, truncations, infos = envs.step(actions)
        real_next_obs = next_obs.copy()
        for idx, trunc in enumerate(truncations):
            if trunc:
                real_next_obs[idx] = infos["final_obs"][idx]
        if bug == "next":
            real_next_obs = obs
        row = global_step % buffer_size
        for table, each in zip(replay, (obs, real_next_obs, actions, rewards, terminations), strict=True):
            table[row] = each
        obs = next_obs

        if global_step > learning_starts:
            if global_step % train_frequency == 0:
                sample = np.random.randint(0, min(global_step + 1, buffer_size), batch_size)
                b_obs, b_next, b_actions, b_rewards, b_dones = (
                    torch.from_numpy(table[sample]) for table in replay
                )
                with torch.no_grad():
                    target_max, _ = target_network(b_next).max(dim=1)
                    dones = torch.zeros(batch_size) if bug == "dones" else b_dones.flatten()
                    td_target = b_rewards.flatten() + gamma * target_max * (1 - dones)
                old_val = q_network(b_obs).gather(1, b_actions).squeeze()
                loss = F.mse_loss(td_target, old_val)
                optimizer.zero_grad()
                loss.backward()  # type: ignore
                optimizer.step()
            if global_step % target_network_frequency == 0 and bug != "target":
                target_network.load_state_dict(q_network.state_dict())
    return {"q": lambda obs: q_network(torch.Tensor(obs)).detach().numpy()}


def layer_init(layer: nn.Linear, std: float = np.sqrt(2), bias_const: float = 0.0) -> nn.Linear:
    torch.nn.init.orthogonal_(layer.weight, std)
    torch.nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    """As in ppo.py."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.critic, self.actor = (
            nn.Sequential(
                *(layer_init(nn.Linear(inputs, 64)), nn.Tanh(), layer_init(nn.Linear(64, 64)), nn.Tanh()),
                layer_init(nn.Linear(64, size), std=std),
            )
            for size, std in ((1, 1.0), (outputs, 0.01))
        )

    def get_action_and_value(self, x: torch.Tensor, action: torch.Tensor | None = None) -> tuple[Any, ...]:
        probs = Categorical(logits=self.actor(x))
        if action is None:
            action = probs.sample()
        return action, probs.log_prob(action), probs.entropy(), self.critic(x)


def ppo(
    env: gym.Env[Any, Any],
    total_timesteps: int,
    seed: int,
    gamma: float = 0.99,
    ent_coef: float = 0.01,
    bug: str = "",
) -> dict[str, Any]:
    """ppo.py. Bugs: sign, dones, gamma, leak; and truncated, which is ppo.py's own."""
    learning_rate, num_steps, num_minibatches, update_epochs = 2.5e-3, 128, 4, 4
    gae_lambda, clip_coef, vf_coef, max_grad_norm = 0.95, 0.2, 0.5, 0.5
    envs = vector(env, seed)
    inputs, outputs = env.observation_space.shape[0], int(env.action_space.n)  # type: ignore
    agent = Agent(inputs, outputs)
    optimizer = optim.Adam(agent.parameters(), lr=learning_rate, eps=1e-5)
    obs = torch.zeros((num_steps, inputs))
    actions, logprobs, rewards, dones, values = torch.zeros((5, num_steps))
    num_iterations = total_timesteps // num_steps

    next_obs = torch.Tensor(envs.reset(seed=seed)[0])
    next_done = torch.zeros(1)
    for iteration in range(1, num_iterations + 1):
        optimizer.param_groups[0]["lr"] = (1.0 - (iteration - 1.0) / num_iterations) * learning_rate
        for step in range(num_steps):
            obs[step], dones[step] = next_obs, next_done
            with torch.no_grad():
                action, logprob, _, value = agent.get_action_and_value(next_obs)
            values[step], actions[step], logprobs[step] = value.flatten(), action, logprob
            new_obs, reward, terminations, truncations, infos = envs.step(action.numpy())
            if truncations[0] and bug not in ("truncated", "leak"):
                with torch.no_grad():
                    reward = reward + gamma * agent.critic(torch.Tensor(infos["final_obs"][0])).numpy()
            over = np.logical_or(terminations, truncations)
            next_done = torch.Tensor(terminations if bug == "leak" else over)
            rewards[step] = torch.tensor(reward).view(-1)
            next_obs = torch.Tensor(new_obs)

        with torch.no_grad():
            next_value = agent.critic(next_obs).flatten()
            discount = 1.0 if bug == "gamma" else gamma
            advantages, lastgaelam = torch.zeros_like(rewards), torch.zeros(1)
            for t in reversed(range(num_steps)):
                last = t == num_steps - 1
                nextnonterminal = 1.0 - (next_done if last else dones[t + 1])
                if bug == "dones":
                    nextnonterminal = torch.ones(1)
                nextvalues = next_value if last else values[t + 1]
                delta = rewards[t] + discount * nextvalues * nextnonterminal - values[t]
                lastgaelam = delta + discount * gae_lambda * nextnonterminal * lastgaelam
                advantages[t] = lastgaelam
            returns = advantages + values

        b_inds = np.arange(num_steps)
        for _ in range(update_epochs):
            np.random.shuffle(b_inds)
            for mb_inds in np.split(b_inds, num_minibatches):
                _, newlogprob, entropy, newvalue = agent.get_action_and_value(obs[mb_inds], actions[mb_inds])
                ratio = (newlogprob - logprobs[mb_inds]).exp()
                mb_advantages = advantages[mb_inds]
                mb_advantages = (mb_advantages - mb_advantages.mean()) / (mb_advantages.std() + 1e-8)
                if bug == "sign":
                    mb_advantages = -mb_advantages
                pg_loss1 = -mb_advantages * ratio
                pg_loss2 = -mb_advantages * torch.clamp(ratio, 1 - clip_coef, 1 + clip_coef)
                pg_loss = torch.max(pg_loss1, pg_loss2).mean()
                newvalue, old = newvalue.view(-1), values[mb_inds]
                v_clipped = old + torch.clamp(newvalue - old, -clip_coef, clip_coef)
                v_loss = torch.max((newvalue - returns[mb_inds]) ** 2, (v_clipped - returns[mb_inds]) ** 2)
                loss = pg_loss - ent_coef * entropy.mean() + 0.5 * v_loss.mean() * vf_coef
                optimizer.zero_grad()
                loss.backward()  # type: ignore
                nn.utils.clip_grad_norm_(agent.parameters(), max_grad_norm)
                optimizer.step()
    return {
        "policy": lambda obs: agent.actor(torch.Tensor(obs)).softmax(dim=0).detach().numpy(),
        "values": lambda obs: agent.critic(torch.Tensor(obs)).item(),
    }
