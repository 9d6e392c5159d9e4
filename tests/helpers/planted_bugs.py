"""PPO, A2C, DQN and QR-DQN with one bug each, as implementations have them.

Each call below makes a class of this module: its name, what is wrong with it, the probes that it must fail
(the first is its own), and the methods that are changed, of the algorithm, of its buffer or of its policy.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.dqn.policies import DQNPolicy

Patch = Callable[..., Any]  # takes the object, the method that it has otherwise, and the method's arguments
CAUGHT: dict[type, tuple[str, ...]] = {}  # by class: the probes that it must fail
_CLASSES: dict[str, type] = {}


def __getattr__(name: str) -> Any:
    if name in _CLASSES:
        return _CLASSES[name]
    raise AttributeError(name)


def _derived(name: str, base: type, patches: dict[str, Patch], **members: Any) -> type:
    kind = type(name, (base,), {"__module__": __name__, **members})
    for method, patch in patches.items():

        def call(self: Any, *given: Any, method: str = method, patch: Patch = patch, **named: Any) -> Any:
            return patch(self, getattr(super(kind, self), method), *given, **named)

        setattr(kind, method, call)
    return kind


def _bug(name: str, base: type, what: str, probes: str, **patches: Patch) -> None:
    _CLASSES[name] = _derived(name, base, patches, __doc__=what)
    CAUGHT[_CLASSES[name]] = tuple(probes.split())


def _policy_bug(name: str, base: type, what: str, probes: str, **patches: Patch) -> None:
    policy = _derived(f"{name}Policy", ActorCriticPolicy if base is PPO else DQNPolicy, patches)
    _bug(name, base, what, probes)
    _CLASSES[name].policy_aliases = {"MlpPolicy": policy}  # type: ignore[attr-defined]


def _buffer_bug(name: str, base: type, what: str, probes: str, **patches: Patch) -> None:
    parent = RolloutBuffer if base is PPO else ReplayBuffer
    option = "rollout_buffer_class" if base is PPO else "replay_buffer_class"
    given = {option: _derived(f"{name}Buffer", parent, patches)}
    _bug(name, base, what, probes, __init__=lambda _, init, *words, **named: init(*words, **given, **named))


# ---- patches -----------------------------------------------------------------------------------------------


def _then(act: Callable[[Any], object]) -> Patch:
    """Something more, once the method has run."""

    def patch(self: Any, method: Callable[..., Any], *given: Any, **named: Any) -> None:
        method(*given, **named)
        act(self)

    return patch


def _after(**values: Callable[[Any], Any]) -> Patch:
    """Attributes get these values once the method has run."""
    return _then(lambda self: vars(self).update({name: value(self) for name, value in values.items()}))


def _during(**values: Callable[[Any], Any]) -> Patch:
    """Attributes have these values while the method runs."""

    def patch(self: Any, method: Callable[..., Any], *given: Any, **named: Any) -> Any:
        before = {name: getattr(self, name) for name in values}
        vars(self).update({name: value(self) for name, value in values.items()})
        found = method(*given, **named)
        vars(self).update(before)
        return found

    return patch


def _stores(**changed: Callable[[Any, dict[str, Any]], Any]) -> Patch:
    """The buffer's `add` stores something else; it is computed from the buffer and what is to be stored."""

    def patch(self: Any, add: Callable[..., Any], *given: Any, **named: Any) -> None:
        replay = ("obs", "next_obs", "action", "reward", "done", "infos")
        names = replay if isinstance(self, ReplayBuffer) else ("obs", "action", "reward")
        step = dict(zip(names, given, strict=False))
        step |= {name: change(self, step) for name, change in changed.items()}
        add(*step.values(), *given[len(step) :], **named)

    return patch


def _late(name: str) -> Callable[[Any, dict[str, Any]], Any]:
    """That of the step before."""

    def before(buffer: Any, step: dict[str, Any]) -> Any:
        last = getattr(buffer, "last", np.zeros_like(step[name]))
        buffer.last = np.array(step[name])
        return last

    return before


def _without_timeouts(infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
    for info in infos:
        info.pop("TimeLimit.truncated", None)
    return infos


def _swapped(obs: Any) -> Any:
    """The first two columns in another order."""
    return obs[:, [1, 0, *range(2, obs.shape[1])]] if obs.shape[1] > 1 else obs


def _endless(self: Any, compute: Callable[..., None], last_values: torch.Tensor, dones: np.ndarray) -> None:
    self.episode_starts[:] = 0.0
    compute(last_values, np.zeros_like(dones))


def _entropy_of_mean(self: Any, method: Callable[..., Any], obs: Any, actions: torch.Tensor) -> Any:
    values, log_prob, entropy = method(obs, actions)
    mean = self.get_distribution(obs).distribution.probs.mean(dim=0)
    return values, log_prob, (-(mean * mean.log()).sum()).expand_as(entropy)


def _crash(self: Any, train: Callable[..., None]) -> None:
    raise RuntimeError("shapes do not fit")


def _kill_units(model: Any) -> None:
    for net in (model.q_net, model.q_net_target):
        torch.nn.init.constant_(net.q_net[0].bias, -100.0)


def _average_targets(model: Any) -> None:
    forward = model.q_net_target.forward

    def averaged(obs: Any) -> torch.Tensor:
        q: torch.Tensor = forward(obs)
        return q.mean(dim=1, keepdim=True).expand_as(q)

    model.q_net_target.forward = averaged


def _targets_from_zero(model: Any) -> None:
    forward = model.q_net_target.forward
    model.q_net_target.forward = lambda obs: forward(obs).clamp(min=0)


def _never_negative(_: Any, make: Callable[..., Any]) -> Any:
    net = make()
    net.q_net.append(torch.nn.Softplus())
    return net


def _bonus_times(factor: float) -> Patch:
    return _during(ent_coef=lambda model: factor * model.ent_coef)


# fmt: off
# ---- PPO and A2C -------------------------------------------------------------------------------------------

_buffer_bug(
    "WrongSign", PPO, "The advantage has the wrong sign.", "choice context",
    compute_returns_and_advantage=_after(advantages=lambda buffer: -buffer.advantages),
)
_buffer_bug(
    "PPOBootstrapsTerminal", PPO, "Episodes are never over.", "termination",
    compute_returns_and_advantage=_endless,
)
_buffer_bug(
    "PPORewardsShifted", PPO, "Each reward belongs to the step before.", "discount",
    add=_stores(reward=_late("reward")),
)
_buffer_bug(
    "PPOGammaForgotten", PPO, "The returns are not discounted.", "discount",
    compute_returns_and_advantage=_during(gamma=lambda _: 1.0),
)
_buffer_bug(
    "PPOActionsShifted", PPO, "Each action is that of the step before.", "context",
    add=_stores(action=_late("action")),
)
_buffer_bug(
    "PPOOnlyRewards", PPO, "The return is the next reward.", "delay discount",
    compute_returns_and_advantage=_after(
        advantages=lambda buffer: buffer.rewards - buffer.values, returns=lambda buffer: buffer.rewards.copy()
    ),
)
_bug(
    "PPOTimeoutsAreEnds", PPO, "It never learns that the step limit ended an episode.", "truncation",
    _update_info_buffer=lambda _, update, infos, *dones: update(_without_timeouts(infos), *dones),
)
_policy_bug(
    "PPOColumnsReversed", PPO, "It sees all columns in the opposite order when it acts.", "behaviour",
    forward=lambda _, forward, obs, *rest: forward(obs.flip(1)),
)
_policy_bug(
    "PPOBlind", PPO, "It learns and acts without looking.", "context",
    extract_features=lambda _, extract, obs, *rest: extract(torch.zeros_like(obs), *rest),
)
_policy_bug(
    "PPOEntropyOfMean", PPO, "The bonus is for the entropy of the policy's mean over states.", "entropy",
    evaluate_actions=_entropy_of_mean,
)
_bug(
    "PPOFrozenLayer", PPO, "The first layer of the policy has no gradient.", "layers",
    _setup_model=_then(lambda model: model.policy.mlp_extractor.policy_net[0].requires_grad_(False)),
)
_buffer_bug(
    "PPORewardsClipped", PPO, "Rewards are clipped to [-1, 1].", "large",
    add=_stores(reward=lambda _, step: np.clip(step["reward"], -1, 1)),
)
_buffer_bug(
    "PPOReturnsFromZero", PPO, "Returns are cut off at 0.", "costs",
    compute_returns_and_advantage=_after(returns=lambda buffer: np.maximum(buffer.returns, 0)),
)
_bug(
    "PPONoValueLoss", PPO, "The loss of the value has no weight.", "constant",
    train=_during(vf_coef=lambda _: 0.0),
)
_bug("PPOCrashes", PPO, "It raises an exception when it learns.", "constant", train=_crash)
for _name, _base, _what, _factor in (
    ("PPOEntropySign", PPO, "Entropy is a cost.", -1.0),
    ("A2CEntropySign", A2C, "Entropy is a cost.", -1.0),
    ("A2CNoEntropy", A2C, "The entropy bonus is forgotten.", 0.0),
    ("PPOEntropyInBits", PPO, "Entropy is measured in bits.", 1 / np.log(2)),
):
    _bug(_name, _base, _what, "entropy", train=_bonus_times(_factor))

# ---- DQN and QR-DQN -----------------------------------------------------------------------------

_bug(
    "NoTargetNetwork", DQN, "The targets are computed with the network that learns.", "target",
    _setup_model=_after(q_net_target=lambda model: model.q_net),
)
_bug(
    "TargetNeverUpdated", DQN, "The target network stays as it was made.", "truncation",
    _on_step=_during(target_update_interval=lambda _: 10**9),
)
_buffer_bug(
    "DQNBootstrapsTerminal", DQN, "Episodes are never over.", "termination",
    add=_stores(done=lambda _, step: np.zeros_like(step["done"])),
)
_buffer_bug(
    "DQNTimeoutsAreEnds", DQN, "It never learns that the step limit ended an episode.", "truncation",
    add=_stores(infos=lambda _, step: _without_timeouts(step["infos"])),
)
_buffer_bug(
    "ReplayOffByOne", DQN, "The next observation is that before the step.", "alternation delay",
    add=_stores(next_obs=lambda _, step: np.array(step["obs"])),
)
_buffer_bug(
    "DQNRewardsShifted", DQN, "Each reward belongs to the step before.", "discount",
    add=_stores(reward=_late("reward")),
)
_buffer_bug(
    "CostsLost", DQN, "Negative rewards are cut off.", "trap",
    add=_stores(reward=lambda _, step: np.maximum(step["reward"], 0.0)),
)
_buffer_bug(
    "DQNRewardsClipped", DQN, "Rewards are clipped to [-1, 1].", "large",
    add=_stores(reward=lambda _, step: np.clip(step["reward"], -1, 1)),
)
_bug(
    "DQNBestFromZero", DQN, "The best next value is searched from 0.", "costs",
    _setup_model=_then(_targets_from_zero),
)
_policy_bug("DQNNeverNegative", DQN, "Its values are never negative.", "costs", make_q_net=_never_negative)
_bug(
    "DQNGammaForgotten", DQN, "Its discount is always 0.99.", "discount",
    train=_during(gamma=lambda _: 0.99),
)
for _name, _what, _probes, _rate in (
    ("EpsilonNeverFalls", "It explores as much at the end as at the beginning.", "behaviour", lambda _: 1.0),
    ("EpsilonStaysAtTenth", "Epsilon never falls below 0.1.", "behaviour",
     lambda m: max(m.exploration_rate, 0.1)),
    ("EpsilonRises", "It explores more and more.", "behaviour exploration",
     lambda m: m.exploration_initial_eps - m.exploration_rate),
    ("EpsilonIgnored", "It acts greedily from the first update on.", "exploration", lambda _: 0.0),
    ("EpsilonHalved", "It explores half as often as it should.", "exploration",
     lambda m: m.exploration_rate / 2),
):
    _bug(_name, DQN, _what, _probes, _on_step=_after(exploration_rate=_rate))
_bug(
    "EpsilonCountsCalls", DQN,
    "Epsilon falls with the calls of `step`, not with the steps of all environments.", "behaviour",
    _on_step=_during(
        _current_progress_remaining=lambda m: 1 - (1 - m._current_progress_remaining) / m.n_envs),
)
_bug(
    "QRDQNEpsilonNeverFalls", QRDQN, "It explores as much at the end as at the beginning.", "behaviour",
    _on_step=_after(exploration_rate=lambda m: m.exploration_initial_eps),
)
_bug(
    "DQNFrozenLayer", DQN, "The last layer has no gradient.", "layers",
    _setup_model=_then(lambda model: model.q_net.q_net[-1].requires_grad_(False)),
)
_bug(
    "DQNDeadUnits", DQN, "The units of the first layer never fire.", "context",
    _setup_model=_then(_kill_units),
)
_bug(
    "DQNColumnsSwapped", DQN, "It sees the first two columns in another order when it acts in training.",
    "behaviour",
    _sample_action=_during(_last_obs=lambda model: _swapped(model._last_obs)),
)
_policy_bug(
    "WorstAction", DQN, "Its deterministic policy takes the action with the least value.", "choice",
    _predict=lambda self, _, obs, *rest, **named: self.q_net(obs).argmin(dim=1).reshape(-1),
)
_bug(
    "MeanOfNext", DQN, "Targets take the mean over the next actions instead of the best one.", "alternation",
    _setup_model=_then(_average_targets),
)
_CLASSES["QuietDQN"] = _derived("QuietDQN", DQN, {}, __doc__="No bug at all.")
