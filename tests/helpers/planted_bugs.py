"""PPO, A2C, DQN and QR-DQN with one bug each, as implementations have them; `CAUGHT` has the probes."""

from typing import Any, ClassVar

import numpy as np
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.dqn.policies import DQNPolicy


class _BuggyRollouts(PPO):
    buffer: type[RolloutBuffer]

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, rollout_buffer_class=self.buffer, **options)


class _BuggyReplay(DQN):
    buffer: type[ReplayBuffer]

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, replay_buffer_class=self.buffer, **options)


class _Negated(RolloutBuffer):
    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        super().compute_returns_and_advantage(last_values, dones)
        self.advantages *= -1


class WrongSign(_BuggyRollouts):
    """The advantage has the wrong sign."""

    buffer = _Negated


class _Endless(RolloutBuffer):
    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        self.episode_starts[:] = 0.0
        super().compute_returns_and_advantage(last_values, np.zeros_like(dones))


class PPOBootstrapsTerminal(_BuggyRollouts):
    """Episodes are never over."""

    buffer = _Endless


class _LateRewards(RolloutBuffer):
    def add(self, obs: Any, action: Any, reward: Any, *rest: Any) -> None:
        late = getattr(self, "late", np.zeros_like(reward))
        self.late = np.array(reward)
        super().add(obs, action, late, *rest)


class PPORewardsShifted(_BuggyRollouts):
    """Each reward belongs to the step before."""

    buffer = _LateRewards


class _NoDiscount(RolloutBuffer):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **{**options, "gamma": 1.0})


class PPOGammaForgotten(_BuggyRollouts):
    """The returns are not discounted."""

    buffer = _NoDiscount


class _OtherActions(RolloutBuffer):
    def add(self, obs: Any, action: Any, *rest: Any) -> None:
        late = getattr(self, "late", np.zeros_like(action))
        self.late = np.array(action)
        super().add(obs, late, *rest)


class PPOActionsShifted(_BuggyRollouts):
    """Each action is that of the step before."""

    buffer = _OtherActions


class _RewardsAlone(RolloutBuffer):
    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        self.advantages[:] = self.rewards - self.values
        self.returns[:] = self.rewards


class PPOOnlyRewards(_BuggyRollouts):
    """The return is the next reward."""

    buffer = _RewardsAlone


def _forget(infos: list[dict[str, Any]]) -> None:
    for info in infos:
        info.pop("TimeLimit.truncated", None)


class PPOTimeoutsAreEnds(PPO):
    """It never learns that the step limit ended an episode."""

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Any = None) -> None:
        _forget(infos)
        super()._update_info_buffer(infos, dones)


class _ActsOnSwapped(ActorCriticPolicy):
    def forward(self, obs: torch.Tensor, deterministic: bool = False) -> Any:
        return super().forward(obs[:, [1, 0, *range(2, obs.shape[1])]] if obs.shape[1] > 1 else obs)


class PPOColumnsSwapped(PPO):
    """It sees the first two columns in another order when it acts."""

    policy_aliases: ClassVar = {"MlpPolicy": _ActsOnSwapped}


class _ActsOnReversed(ActorCriticPolicy):
    def forward(self, obs: torch.Tensor, deterministic: bool = False) -> Any:
        return super().forward(obs.flip(1))


class PPOColumnsReversed(PPO):
    """It sees all columns in the opposite order when it acts."""

    policy_aliases: ClassVar = {"MlpPolicy": _ActsOnReversed}


class PPOFrozenLayer(PPO):
    """The first layer of the policy has no gradient."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.policy.mlp_extractor.policy_net[0].requires_grad_(False)


class PPONoValueLoss(PPO):
    """The loss of the value has no weight."""

    def train(self) -> None:
        self.vf_coef = 0.0
        super().train()


class PPOBlind(PPO):
    """It learns and acts without looking."""

    class Blind(ActorCriticPolicy):
        def extract_features(self, obs: torch.Tensor, *rest: Any) -> Any:
            return super().extract_features(torch.zeros_like(obs), *rest)

    policy_aliases: ClassVar = {"MlpPolicy": Blind}


class _OtherBonus:
    """The entropy bonus is multiplied."""

    ent_coef: float
    factor: float

    def train(self) -> None:
        asked = self.ent_coef
        self.ent_coef = self.factor * asked
        super().train()  # type: ignore[misc]
        self.ent_coef = asked


class PPOEntropySign(_OtherBonus, PPO):
    """Entropy is a cost."""

    factor = -1.0


class A2CEntropySign(_OtherBonus, A2C):
    """Entropy is a cost."""

    factor = -1.0


class A2CNoEntropy(_OtherBonus, A2C):
    """The entropy bonus is forgotten."""

    factor = 0.0


class PPOEntropySummed(_OtherBonus, PPO):
    """Entropy is summed over the samples, not averaged."""

    factor = 256.0


class PPOEntropyInBits(_OtherBonus, PPO):
    """Entropy is measured in bits."""

    factor = 1 / np.log(2)


class _EntropyOfMean(ActorCriticPolicy):
    def evaluate_actions(self, obs: Any, actions: torch.Tensor) -> Any:
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        mean = self.get_distribution(obs).distribution.probs.mean(dim=0)
        return values, log_prob, (-(mean * mean.log()).sum()).expand_as(entropy)


class PPOEntropyOfMean(PPO):
    """The bonus is for the entropy of the policy's mean over states."""

    policy_aliases: ClassVar = {"MlpPolicy": _EntropyOfMean}


class PPOCrashes(PPO):
    """It raises an exception when it learns."""

    def train(self) -> None:
        raise RuntimeError("shapes do not fit")


class NoTargetNetwork(DQN):
    """The targets are computed with the network that learns."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.q_net_target = self.q_net


class TargetNeverUpdated(DQN):
    """The target network stays as it was made."""

    def _on_step(self) -> None:
        wanted, self.target_update_interval = self.target_update_interval, 10**9
        super()._on_step()
        self.target_update_interval = wanted


class _NoEnds(ReplayBuffer):
    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: Any) -> None:
        super().add(obs, next_obs, action, reward, np.zeros_like(done), infos)


class DQNBootstrapsTerminal(_BuggyReplay):
    """Episodes are never over."""

    buffer = _NoEnds


class _TimeoutsAreEnds(ReplayBuffer):
    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: Any) -> None:
        _forget(infos)
        super().add(obs, next_obs, action, reward, done, infos)


class DQNTimeoutsAreEnds(_BuggyReplay):
    """It never learns that the step limit ended an episode."""

    buffer = _TimeoutsAreEnds


class _SameObservation(ReplayBuffer):
    def add(self, obs: Any, next_obs: Any, *rest: Any) -> None:
        super().add(obs, np.array(obs), *rest)


class ReplayOffByOne(_BuggyReplay):
    """The next observation is that before the step."""

    buffer = _SameObservation


class _LateReplay(ReplayBuffer):
    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: Any) -> None:
        late = getattr(self, "late", np.zeros_like(reward))
        self.late = np.array(reward)
        super().add(obs, next_obs, action, late, done, infos)


class DQNRewardsShifted(_BuggyReplay):
    """Each reward belongs to the step before."""

    buffer = _LateReplay


class _OnlyGains(ReplayBuffer):
    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, *rest: Any) -> None:
        super().add(obs, next_obs, action, np.maximum(reward, 0.0), *rest)


class CostsLost(_BuggyReplay):
    """Negative rewards are cut off."""

    buffer = _OnlyGains


class DQNGammaForgotten(DQN):
    """Its discount is always 0.99."""

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        self.gamma = 0.99
        super().train(gradient_steps, batch_size)


class EpsilonNeverFalls(DQN):
    """It explores as much at the end as at the beginning."""

    def _on_step(self) -> None:
        super()._on_step()
        self.exploration_rate = 1.0


class EpsilonStaysAtThird(DQN):
    """Epsilon never falls below 0.3."""

    def _on_step(self) -> None:
        super()._on_step()
        self.exploration_rate = max(self.exploration_rate, 0.3)


class EpsilonStaysAtTenth(DQN):
    """Epsilon never falls below 0.1."""

    def _on_step(self) -> None:
        super()._on_step()
        self.exploration_rate = max(self.exploration_rate, 0.1)


class EpsilonRises(DQN):
    """It explores more and more."""

    def _on_step(self) -> None:
        super()._on_step()
        self.exploration_rate = self.exploration_initial_eps - self.exploration_rate


class EpsilonFallsLate(DQN):
    """Epsilon falls to its end over all of training, whatever the fraction."""

    def _setup_model(self) -> None:
        self.exploration_fraction = 1.0
        super()._setup_model()


class EpsilonCountsCalls(DQN):
    """Epsilon falls with the calls of `step`, not with the steps of all environments."""

    def _on_step(self) -> None:
        left = self._current_progress_remaining
        self._current_progress_remaining = 1 - (1 - left) / self.n_envs
        super()._on_step()
        self._current_progress_remaining = left


class EpsilonIgnored(DQN):
    """It acts greedily from the first update on."""

    def _on_step(self) -> None:
        super()._on_step()
        self.exploration_rate = 0.0


class EpsilonHalved(DQN):
    """It explores half as often as it should."""

    def _on_step(self) -> None:
        super()._on_step()
        self.exploration_rate /= 2


class QRDQNEpsilonNeverFalls(QRDQN):
    """It explores as much at the end as at the beginning."""

    def _on_step(self) -> None:
        super()._on_step()
        self.exploration_rate = self.exploration_initial_eps


class DQNFrozenLayer(DQN):
    """The last layer has no gradient."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.q_net.q_net[-1].requires_grad_(False)


class DQNDeadUnits(DQN):
    """The units of the first layer never fire."""

    def _setup_model(self) -> None:
        super()._setup_model()
        for net in (self.q_net, self.q_net_target):
            torch.nn.init.constant_(net.q_net[0].bias, -100.0)


class QuietDQN(DQN):
    """No bug at all."""


class DQNColumnsSwapped(DQN):
    """It sees the first two columns in another order when it acts in training."""

    def _sample_action(self, *arguments: Any, **options: Any) -> Any:
        seen, columns = self._last_obs, self._last_obs.shape[1]
        self._last_obs = seen[:, [1, 0, *range(2, columns)]] if columns > 1 else seen
        found = super()._sample_action(*arguments, **options)
        self._last_obs = seen
        return found


class WorstAction(DQN):
    """Its deterministic policy takes the action with the least value."""

    class Worst(DQNPolicy):
        def _predict(self, obs: Any, deterministic: bool = True) -> torch.Tensor:
            return self.q_net(obs).argmin(dim=1).reshape(-1)

    policy_aliases: ClassVar = {"MlpPolicy": Worst}


class MeanOfNext(DQN):
    """Targets take the mean over the next actions instead of the best one."""

    def _setup_model(self) -> None:
        super()._setup_model()
        forward = self.q_net_target.forward

        def averaged(obs: Any) -> torch.Tensor:
            q = forward(obs)
            return q.mean(dim=1, keepdim=True).expand_as(q)

        self.q_net_target.forward = averaged


# By class: the probes that it must fail, of which the first is its own.
CAUGHT: dict[type, tuple[str, ...]] = {
    WrongSign: ("choice", "context"),
    PPOBootstrapsTerminal: ("termination",),
    PPORewardsShifted: ("discount",),
    PPOGammaForgotten: ("discount",),
    PPOActionsShifted: ("context",),
    PPOOnlyRewards: ("delay", "discount"),
    PPOTimeoutsAreEnds: ("truncation",),
    PPOColumnsSwapped: ("behaviour",),
    PPOColumnsReversed: ("behaviour",),
    PPOFrozenLayer: ("layers",),
    PPONoValueLoss: ("constant",),
    PPOBlind: ("context",),
    PPOCrashes: ("constant",),
    PPOEntropySign: ("entropy",),
    A2CEntropySign: ("entropy",),
    A2CNoEntropy: ("entropy",),
    PPOEntropySummed: ("entropy",),
    PPOEntropyInBits: ("entropy",),
    PPOEntropyOfMean: ("entropy",),
    NoTargetNetwork: ("target",),
    TargetNeverUpdated: ("truncation",),
    DQNBootstrapsTerminal: ("termination",),
    DQNTimeoutsAreEnds: ("truncation",),
    ReplayOffByOne: ("alternation", "delay"),
    DQNRewardsShifted: ("discount",),
    CostsLost: ("trap",),
    DQNGammaForgotten: ("discount",),
    EpsilonNeverFalls: ("behaviour",),
    EpsilonStaysAtThird: ("behaviour",),
    EpsilonStaysAtTenth: ("behaviour",),
    EpsilonRises: ("behaviour", "exploration"),
    EpsilonFallsLate: ("behaviour",),
    EpsilonCountsCalls: ("behaviour",),
    EpsilonIgnored: ("exploration",),
    EpsilonHalved: ("exploration",),
    QRDQNEpsilonNeverFalls: ("behaviour",),
    DQNFrozenLayer: ("layers",),
    DQNDeadUnits: ("context",),
    DQNColumnsSwapped: ("behaviour",),
    WorstAction: ("choice",),
    MeanOfNext: ("alternation",),
}
