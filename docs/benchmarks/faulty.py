"""Faults that others have collected, as classes derived from Stable-Baselines3's DQN, PPO and A2C.

The operators are those of RLMutation (Tambon et al., 2023) and the programs those of DRLinter (Nikanjam et
al., 2022), written anew for Stable-Baselines3. `faults.py` trains them and has the faults that are settings.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.dqn.policies import DQNPolicy
from torch.nn import functional

# ---- what the agent is shown of its environment: RLMutation's four operators, each at every step -----------


class _Shown(VecEnvWrapper):
    """An environment that is shown wrongly; `change` says how."""

    def reset(self) -> Any:
        self.memory: list[tuple[Any, Any]] = []
        self.obs = self.venv.reset()
        return self.obs

    def step_wait(self) -> Any:
        obs, rewards, dones, infos = self.venv.step_wait()
        shown, rewards = self.change(np.array(obs), np.array(rewards), dones)
        self.memory = [*self.memory[-999:], (np.array(obs), np.array(rewards))]
        self.obs = shown
        return shown, rewards, dones, infos

    def change(self, obs: Any, rewards: Any, dones: Any) -> tuple[Any, Any]:
        raise NotImplementedError

    def drawn(self) -> tuple[Any, Any]:
        """An earlier observation and reward of each environment."""
        return self.memory[np.random.randint(len(self.memory))]


class RewardNoise(_Shown):
    """The reward has noise of a tenth of its size."""

    def change(self, obs: Any, rewards: Any, dones: Any) -> tuple[Any, Any]:
        return obs, rewards + np.random.normal(size=len(rewards)) * 0.1 * np.abs(rewards)


class Repeat(_Shown):
    """The observation and the reward are those of the step before."""

    def change(self, obs: Any, rewards: Any, dones: Any) -> tuple[Any, Any]:
        return self.memory[-1] if self.memory else (obs, rewards)


class Random(_Shown):
    """The observation and the reward are those of some earlier step."""

    def change(self, obs: Any, rewards: Any, dones: Any) -> tuple[Any, Any]:
        return self.drawn() if self.memory else (obs, rewards)


class Mangled(_Shown):
    """The observation is of some earlier step, and the reward of another."""

    def change(self, obs: Any, rewards: Any, dones: Any) -> tuple[Any, Any]:
        return (self.drawn()[0], self.drawn()[1]) if self.memory else (obs, rewards)


class NotReset(_Shown):
    """An episode begins with the observation that ended the one before, as if `reset` were not called."""

    def step_wait(self) -> Any:
        obs, rewards, dones, infos = self.venv.step_wait()
        obs = np.array(obs)
        for index in np.flatnonzero(dones):
            obs[index] = infos[index]["terminal_observation"]
        return obs, rewards, dones, infos


class NotStepped(_Shown):
    """`step` is not called: nothing is ever seen but the first observation."""

    def step_async(self, actions: Any) -> None:
        self.count = len(actions)

    def step_wait(self) -> Any:
        nothing = np.zeros(self.count)
        return self.obs, nothing.astype(np.float32), nothing.astype(bool), [{} for _ in nothing]


# ---- the same for an algorithm that is given its environment -----------------------------------------------


def _derived(base: type, name: str, what: str, **members: Any) -> type:
    kind = type(f"{base.__name__}{name}", (base,), {"__module__": __name__, "__doc__": what, **members})
    globals()[kind.__name__] = kind
    return kind


def _sees(base: type, shown: type[_Shown]) -> None:
    def build(self: Any, policy: Any, env: VecEnv, *given: Any, **named: Any) -> None:
        base.__init__(self, policy, shown(env), *given, **named)  # type: ignore[misc]

    _derived(base, shown.__name__, str(shown.__doc__), __init__=build)


for _base in (DQN, PPO, A2C):
    for _shown in (RewardNoise, Repeat, Random, Mangled):
        _sees(_base, _shown)
for _shown in (NotReset, NotStepped):
    _sees(DQN, _shown)


# ---- what is stored ----------------------------------------------------------------------------------------


class _NeverDone(ReplayBuffer):
    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: Any) -> None:
        super().add(obs, next_obs, action, reward, np.zeros_like(done), infos)


class _StateKept(ReplayBuffer):
    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: Any) -> None:
        super().add(obs, np.array(obs), action, reward, done, infos)


class _EndlessRollout(RolloutBuffer):
    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        self.episode_starts[:] = 0
        super().compute_returns_and_advantage(last_values, np.zeros_like(dones))


class _UndiscountedRollout(RolloutBuffer):
    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        gamma, self.gamma = self.gamma, 1.0
        super().compute_returns_and_advantage(last_values, dones)
        self.gamma = gamma


class _ForwardRollout(RolloutBuffer):
    """Advantages are summed from the first step on instead of from the last."""

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        values = np.concatenate([self.values, last_values.clone().cpu().numpy().reshape(1, -1)])
        ends = np.concatenate([self.episode_starts[1:], np.asarray(dones)[None]])
        kept, advantage = 1.0 - ends, np.zeros(self.n_envs)
        for step in range(self.buffer_size):
            delta = self.rewards[step] + self.gamma * values[step + 1] * kept[step] - values[step]
            advantage = delta + self.gamma * self.gae_lambda * kept[step] * advantage
            self.advantages[step] = advantage
        self.returns = self.advantages + self.values


class _FirstStateRollout(RolloutBuffer):
    """Each rollout has its first observation at every step."""

    def add(self, obs: Any, *given: Any) -> None:
        if self.pos == 0:
            self.first = np.array(obs)
        super().add(self.first, *given)


def _stores(base: type, name: str, what: str, buffer: type) -> None:
    option = "replay_buffer_class" if base is DQN else "rollout_buffer_class"

    def build(self: Any, *given: Any, **named: Any) -> None:
        base.__init__(self, *given, **{option: buffer} | named)  # type: ignore[misc]

    _derived(base, name, what, __init__=build)


_stores(DQN, "MissingTerminal", "The end of an episode is not stored.", _NeverDone)
_stores(DQN, "MissingStateUpdate", "The next observation is the one before the step.", _StateKept)
for _base in (PPO, A2C):
    _stores(_base, "MissingTerminal", "The end of an episode is not stored.", _EndlessRollout)
    _stores(_base, "MissingStateUpdate", "The observation is never updated.", _FirstStateRollout)
    _stores(_base, "NoDiscount", "Returns are not discounted.", _UndiscountedRollout)
    _stores(_base, "NoReverse", "Returns are summed in the wrong order.", _ForwardRollout)


# ---- what is computed --------------------------------------------------------------------------------------


class _Negated(RolloutBuffer):
    """With advantages of the opposite sign, the loss of the policy has the opposite sign."""

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        super().compute_returns_and_advantage(last_values, dones)
        self.advantages = -self.advantages


for _base in (PPO, A2C):
    _stores(_base, "IncorrectLoss", "The loss of the policy has the wrong sign.", _Negated)


class _Targets(DQN):
    """DQN with other targets; `target` computes them."""

    def target(self, rewards: Any, dones: Any, best: Any) -> Any:
        raise NotImplementedError

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        for _ in range(gradient_steps):
            data = self.replay_buffer.sample(batch_size)
            with torch.no_grad():
                best = self.q_net_target(data.next_observations).max(dim=1, keepdim=True)[0]
                targets = self.target(data.rewards, data.dones, best)
            loss = functional.smooth_l1_loss(self.predicted(data), targets)
            self.policy.optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()
        self._n_updates += gradient_steps

    def predicted(self, data: Any) -> torch.Tensor:
        return torch.gather(self.q_net(data.observations), 1, data.actions.long())


class DQNNoDiscount(_Targets):
    """Targets are not discounted."""

    def target(self, rewards: Any, dones: Any, best: Any) -> Any:
        return rewards + (1 - dones) * best


class DQNIncorrectLoss(_Targets):
    """The value of the next state is subtracted."""

    def target(self, rewards: Any, dones: Any, best: Any) -> Any:
        return rewards - (1 - dones) * self.gamma * best


class DQNWrongUpdateRule(_Targets):
    """The reward is discounted, and the value of the next state subtracted from it."""

    def target(self, rewards: Any, dones: Any, best: Any) -> Any:
        return torch.where(dones > 0, rewards, self.gamma * (rewards - best))


class DQNWithoutAction(_Targets):
    """The highest value is fitted, whatever the action; the last reward of an episode has the wrong sign."""

    def target(self, rewards: Any, dones: Any, best: Any) -> Any:
        return torch.where(dones > 0, -rewards, rewards + self.gamma * best)

    def predicted(self, data: Any) -> torch.Tensor:
        return self.q_net(data.observations).max(dim=1, keepdim=True)[0]


class DQNTargetTaught(DQN):
    """The target's weights are copied to the network that learns, not the other way round."""

    def _on_step(self) -> None:
        before = {name: each.clone() for name, each in self.q_net_target.state_dict().items()}
        refreshes = self._n_calls
        super()._on_step()
        if (refreshes + 1) % max(self.target_update_interval // self.n_envs, 1) == 0:
            self.q_net_target.load_state_dict(before)
            self.q_net.load_state_dict(before)


class DQNTargetKept(DQN):
    """The target network stays as it was made."""

    def _on_step(self) -> None:
        interval, self.target_update_interval = self.target_update_interval, 10**9
        super()._on_step()
        self.target_update_interval = interval


class DQNOneNetworkEndless(DQN):
    """There is no target network, and the end of an episode is not stored."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **{"replay_buffer_class": _NeverDone} | named)

    def _setup_model(self) -> None:
        super()._setup_model()
        self.q_net_target = self.q_net


class DQNEpsilonRises(DQN):
    """Epsilon is divided by its decay instead of multiplied."""

    def _on_step(self) -> None:
        super()._on_step()
        self.exploration_rate = min(1.0, 2 * self.exploration_initial_eps - self.exploration_rate)


class _WithActivation(DQNPolicy):
    last: type[torch.nn.Module]

    def make_q_net(self) -> Any:
        net = super().make_q_net()
        net.q_net.append(self.last(dim=1) if self.last is torch.nn.Softmax else self.last())
        return net


class _MaximumAsAction(DQNPolicy):
    def _predict(self, obs: Any, deterministic: bool = True) -> torch.Tensor:
        most = self.q_net.action_space.n - 1
        return self.q_net(obs).max(dim=1)[0].long().clamp(0, most)


def _acts(name: str, what: str, policy: type[DQNPolicy]) -> None:
    _derived(DQN, name, what, policy_aliases={"MlpPolicy": policy})


_acts("OutputReLU", "The output layer has a ReLU.",
      type("_ReLUPolicy", (_WithActivation,), {"last": torch.nn.ReLU}))  # fmt: skip
_acts("OutputSoftmax", "The output layer has a softmax.",
      type("_SoftmaxPolicy", (_WithActivation,), {"last": torch.nn.Softmax}))  # fmt: skip
_acts("MaximumAsAction", "The action is the highest value, not its index.", _MaximumAsAction)

for _base in (DQN, PPO, A2C):
    _derived(_base, "Sound", "Nothing is changed.")
