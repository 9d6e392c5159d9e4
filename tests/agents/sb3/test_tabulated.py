"""The tabulated engine is SB3, only faster: same losses, same gradients, same files, same interface."""

import copy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.support import DEEP, SHORT, configure, train_in
from sb3_contrib import QRDQN, TRPO, MaskablePPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from gridworld import GridWorldVectorEnv
from gridworld.agents.sb3 import check
from gridworld.agents.sb3.features import AgentByColour, FourierFeatures, PixelCNN
from gridworld.agents.sb3.settings.constructor_arguments import algorithm_and_arguments
from gridworld.agents.sb3.settings.schemas import SB3Config
from gridworld.agents.sb3.tabulated import off_policy
from gridworld.agents.sb3.tabulated import state_inputs as tabulated
from gridworld.agents.sb3.tabulated.a2c import TabulatedA2C
from gridworld.agents.sb3.tabulated.dqn import TabulatedDQN
from gridworld.agents.sb3.tabulated.losses import qrdqn as qrdqn_losses
from gridworld.agents.sb3.tabulated.losses import trpo as trpo_losses
from gridworld.agents.sb3.tabulated.losses.ppo import log_softmax
from gridworld.agents.sb3.tabulated.ppo import TabulatedPPO
from gridworld.agents.sb3.tabulated.qrdqn import TabulatedQRDQN
from gridworld.agents.sb3.tabulated.side_by_side import SideBySide
from gridworld.agents.sb3.tabulated.trpo import TabulatedTRPO
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.envs.observations import make_observation
from gridworld.envs.statistics_env import StatisticsVectorEnv
from gridworld.errors import InputError

NUM_ENVS, STEPS = 16, 32
KINDS = ["one_hot", "coordinates", "none", "image"]


def batch(kind: str) -> GridWorldVecEnv:
    """Slippery, with a short limit: terminations, truncations and both kinds of reward occur."""
    envs = GridWorldVectorEnv(NUM_ENVS, autoreset_mode="SameStep", slip=0.2, max_episode_steps=12)
    return GridWorldVecEnv(envs, make_observation(envs.mdp, kind))


class Keep(KVWriter):
    """Keeps what was logged."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {}

    def write(self, key_values: dict[str, Any], key_excluded: Any, step: int = 0) -> None:
        self.values.update(key_values)

    def close(self) -> None:
        pass


def twins(ours: type, theirs: type, kind: str, **arguments: Any) -> tuple[Any, Any]:
    """The two classes with the same weights, ready to collect."""
    policy = "CnnPolicy" if kind == "image" else "MlpPolicy"
    pair = tuple(
        cls(policy, batch(kind), seed=0, device="cpu", **copy.deepcopy(arguments))  # SB3 writes into it
        for cls in (ours, theirs)
    )
    for model in pair:
        model.policy.load_state_dict(pair[0].policy.state_dict())
        model.set_logger(Logger(None, [Keep()]))
        model._setup_learn(10_000)
    return pair


def no_callback(model: Any) -> CallbackList:
    callback = CallbackList([])
    callback.init_callback(model)
    return callback


def assert_same_update(ours: Any, theirs: Any, *arguments: int) -> None:
    """Train both on what they hold; gradients, weights and everything logged agree to float32 rounding."""
    for model in (ours, theirs):
        np.random.seed(7)
        torch.manual_seed(7)
        model.train(*arguments)
        model.logger.dump()
    for mine, peer in zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True):
        assert torch.allclose(mine, peer, rtol=1e-5, atol=1e-6)
        if peer.grad is not None:
            scale = float(peer.grad.abs().max()) + 1e-12
            assert float((mine.grad - peer.grad).abs().max()) < 2e-5 * scale
    told, expected = (model.logger.output_formats[0].values for model in (ours, theirs))
    assert {key for key in told if key.startswith("train/")} == expected.keys()
    for key, value in expected.items():
        assert told[key] == pytest.approx(value, rel=1e-4, abs=1e-6), key


def share_rollout(ours: Any, theirs: Any, is_moved: bool = True) -> None:
    steps = ours.n_steps
    for _ in range(-(-8 // steps)):  # walks have gone apart
        ours.collect_rollouts(ours.env, no_callback(ours), ours.rollout_buffer, steps)
    source, target = ours.rollout_buffer, theirs.rollout_buffer
    target.reset()
    rows = ours.env.observation.rows(source.observations)
    target.observations = rows.reshape(steps, NUM_ENVS, *target.obs_shape)
    target.actions = source.actions[..., None]
    for name in ("rewards", "episode_starts", "values", "log_probs", "advantages", "returns"):
        setattr(target, name, getattr(source, name).copy())
    target.full = True
    if not is_moved:
        return
    with torch.no_grad():  # the update begins away from the policy that collected
        for mine, peer in zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True):
            mine += 0.05 * torch.randn_like(mine)
            peer.copy_(mine)


SEPARATE = {"policy_kwargs": {"share_features_extractor": False}}
FOURIER = {"policy_kwargs": {"features_extractor_class": FourierFeatures}}
CELLS = {"policy_kwargs": {"features_extractor_class": AgentByColour, "net_arch": [16]}}
# Where a square is the same in an image everywhere, rounding is what is scaled to variance 1: no Adam here.
PIXELS = {
    "policy_kwargs": {
        "features_extractor_class": PixelCNN,
        "net_arch": [16],
        "optimizer_class": torch.optim.SGD,
    }
}
APART = {"policy_kwargs": {**FOURIER["policy_kwargs"], "share_features_extractor": False}}
LINEAR = {"policy_kwargs": {"net_arch": []}}
TWO_SIZES = {"policy_kwargs": {"net_arch": {"pi": [8], "vf": [16, 16]}}}
# RMSprop's first steps are of full size, however small a gradient is: with its own eps rounding would grow.
RMSPROP = {"optimizer_class": torch.optim.RMSprop, "optimizer_kwargs": {"eps": 1e-3}}
RELU = {"activation_fn": torch.nn.ReLU, **RMSPROP}
# Conjugate gradients on a convolutional network's weights would blow rounding up, in SB3's class as here.
FEW_PRODUCTS = {"cg_max_steps": 2, "cg_damping": 1.0, "n_critic_updates": 1}
FROM_ROLLOUTS: dict[tuple[type, type], list[tuple[str, dict[str, Any]]]] = {
    (TabulatedPPO, PPO): [
        *[(kind, {}) for kind in KINDS],
        ("one_hot", {"clip_range": 0.02, "ent_coef": 0.3, "vf_coef": 0.1}),
        ("one_hot", {"clip_range_vf": 0.05}),
        ("one_hot", {"normalize_advantage": False}),
        ("one_hot", {"max_grad_norm": 0.01}),
        ("one_hot", {"target_kl": 1e-3}),
        ("one_hot", {"n_epochs": 3, "batch_size": 100}),
        ("one_hot", {"n_epochs": 3, "batch_size": 10_000}),
        *[("none", LINEAR), ("coordinates", TWO_SIZES), ("coordinates", SEPARATE), ("image", SEPARATE)],
        *[("coordinates", FOURIER), ("image", CELLS), ("image", PIXELS), ("coordinates", APART)],
        ("one_hot", {"policy_kwargs": RELU}),
    ],
    (TabulatedA2C, A2C): [
        *[(kind, {}) for kind in KINDS],
        ("one_hot", {"ent_coef": 0.3, "vf_coef": 0.1, "gae_lambda": 0.9, "normalize_advantage": True}),
        ("one_hot", {"use_rms_prop": False, "max_grad_norm": 0.01}),
        *[("none", LINEAR), ("coordinates", TWO_SIZES), ("image", SEPARATE), ("coordinates", FOURIER)],
        ("image", PIXELS),
    ],
    (TabulatedTRPO, TRPO): [
        *[(kind, {}) for kind in KINDS if kind != "image"],
        *[("image", {**FEW_PRODUCTS, "policy_kwargs": {"share_features_extractor": x}}) for x in (0, 1)],
        ("one_hot", {"normalize_advantage": False, "cg_max_steps": 3, "cg_damping": 1.0}),
        ("one_hot", {"sub_sampling_factor": 3, "gae_lambda": 0.9}),
        ("one_hot", {"target_kl": 0.5, "line_search_shrinking_factor": 0.5, "cg_damping": 1.0}),
        ("one_hot", {"line_search_max_iter": 0}),
        ("one_hot", {"policy_kwargs": {"optimizer_class": torch.optim.AdamW}}),
        *[("none", LINEAR), ("coordinates", TWO_SIZES), ("coordinates", FOURIER)],
    ],
}


def cases(
    by_classes: dict[tuple[type, type], list[tuple[str, dict[str, Any]]]],
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Of the test, for every case of every class, with few and with many states to a batch."""
    values = [(*classes, *case) for classes, listed in by_classes.items() for case in listed]

    def mark(test: Callable[..., None]) -> Callable[..., None]:
        every = pytest.mark.parametrize(("ours", "theirs", "kind", "arguments"), values, ids=str)
        sizes = pytest.mark.parametrize("few_states", [1024, 0], ids=["all states", "distinct states"])
        return every(sizes(test))  # type: ignore[no-any-return]

    return mark


@cases(FROM_ROLLOUTS)
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size of")
def test_updates_from_rollouts_are_as_stock(
    ours: Any,
    theirs: Any,
    kind: str,
    arguments: dict[str, Any],
    few_states: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tabulated, "_FEW_STATES", few_states)
    n_steps = 1 if few_states == 0 and theirs is not PPO else STEPS  # of fewer samples than states
    if few_states == 0 and theirs is PPO:  # so that batches hold fewer distinct ones
        # Many updates then follow each other, in which Adam would blow rounding up to its full step size.
        policy_kwargs = {"optimizer_class": torch.optim.SGD, **arguments.get("policy_kwargs", {})}
        arguments = {"batch_size": 16, **arguments, "policy_kwargs": policy_kwargs}
    fixed: dict[type, dict[str, int]] = {
        PPO: {"n_epochs": 1, "batch_size": 256},
        A2C: {},
        TRPO: {"batch_size": 300, "n_critic_updates": 2},
    }
    ours, theirs = twins(ours, theirs, kind, **{"n_steps": n_steps, **fixed[theirs], **arguments})
    share_rollout(ours, theirs)
    before = [parameter.detach().clone() for parameter in ours.policy.parameters()]
    assert_same_update(ours, theirs)
    if isinstance(theirs, TRPO):
        moved = [not torch.equal(*pair) for pair in zip(before, ours.policy.parameters(), strict=True)]
        told = ours.logger.output_formats[0].values["train/is_line_search_success"]
        assert all(moved) == (told == 1) == ("line_search_max_iter" not in arguments)
        kept = ours.policy.optimizer.state_dict()["state"].keys()
        assert kept == theirs.policy.optimizer.state_dict()["state"].keys() != set(range(len(moved)))


@pytest.mark.parametrize(
    ("ours", "theirs", "arguments"),
    [
        # RMSprop's first steps are of full size, however small a gradient is: rounding would grow.
        (TabulatedA2C, A2C, {"n_steps": 8, "policy_kwargs": {"optimizer_class": torch.optim.SGD}}),
        (TabulatedTRPO, TRPO, {"n_steps": 16, "batch_size": 256, "target_kl": 0.05}),
    ],
)
def test_updates_that_follow_each_other_stay_together(
    ours: Any, theirs: Any, arguments: dict[str, Any]
) -> None:
    ours, theirs = twins(ours, theirs, "one_hot", learning_rate=0.05, **arguments)
    for update in range(12):
        share_rollout(ours, theirs, is_moved=False)
        for model in (ours, theirs):
            model._update_current_progress_remaining(update, 13)
            np.random.seed(update)
            torch.manual_seed(update)
            model.train()
    for mine, peer in zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True):
        assert torch.allclose(mine, peer, rtol=1e-3, atol=1e-4)


def test_trpos_curvature_is_the_divergences_second_derivative() -> None:
    """The table's Fisher product against finite differences of the slope of the divergence."""
    rng = np.random.default_rng(0)
    logits, move = rng.normal(size=(2, 5, 4)), rng.normal(size=(2, 5, 4))
    shares, start = rng.random((2, 5)), log_softmax(logits)
    half = 1e-4
    ahead, behind, here = (
        trpo_losses.divergence(log_softmax(logits + step * move), start, shares) for step in (half, -half, 0)
    )
    product = (move * trpo_losses.curved(np.exp(start), shares, move)).sum(axis=(-2, -1))
    assert np.allclose((ahead - 2 * here + behind) / half**2, product, rtol=1e-4)


def test_ppo_collects_what_stock_would_compute() -> None:
    ours, theirs = twins(TabulatedPPO, PPO, "one_hot", n_steps=STEPS, batch_size=64)
    ours.collect_rollouts(ours.env, no_callback(ours), ours.rollout_buffer, STEPS)
    buffer = ours.rollout_buffer
    rows = torch.as_tensor(ours.env.observation.rows(buffer.observations.ravel()))
    actions = torch.as_tensor(buffer.actions.ravel())
    values, log_probs, _ = theirs.policy.evaluate_actions(rows, actions)
    assert np.allclose(values.detach().flatten(), buffer.values.ravel(), atol=1e-6)
    assert np.allclose(log_probs.detach(), buffer.log_probs.ravel(), atol=1e-6)
    # Starts follow ends, and a time-out's reward holds the value it was cut off from.
    starts = buffer.episode_starts[1:].astype(bool)
    assert (buffer.observations[1:][starts] == 0).all()
    plain = np.isin(buffer.rewards, [-1, 0, 1])
    assert 0 < (~plain).sum() < buffer.rewards.size // 4


@pytest.mark.parametrize(
    ("algorithm", "arguments"),
    [(TabulatedPPO, {"n_steps": STEPS, "batch_size": 64}), (TabulatedDQN, {"learning_starts": 10_000})],
)
def test_buffers_hold_the_exploration_bonus_as_it_was_paid(algorithm: Any, arguments: Any) -> None:
    """Against a naive count of the same walk, and a model on the same walk without a bonus."""
    rewards: list[Any] = []
    world: dict[str, Any] = {"slip": 0.2, "max_episode_steps": 12}
    for bonus in (0.0, 0.5):
        envs = StatisticsVectorEnv(NUM_ENVS, exploration_bonus=bonus, **world)
        env = GridWorldVecEnv(envs, make_observation(envs.mdp, "one_hot"))
        model = algorithm("MlpPolicy", env, seed=0, device="cpu", **arguments)
        model.set_logger(Logger(None, [Keep()]))
        model._setup_learn(10_000)
        if algorithm is TabulatedPPO:
            buffer = model.rollout_buffer
            model.collect_rollouts(env, no_callback(model), buffer, STEPS)
        else:
            buffer = model.replay_buffer
            frequency = TrainFreq(STEPS, TrainFrequencyUnit.STEP)
            model.collect_rollouts(env, no_callback(model), frequency, buffer, learning_starts=10_000)
        rewards.append(buffer.rewards[:STEPS].copy())
    visits, paid = np.zeros(envs.visits.shape), np.zeros((STEPS, NUM_ENVS))
    for step in range(STEPS):
        pairs = list(zip(buffer.observations[step], buffer.actions[step].ravel(), strict=True))
        for pair in pairs:
            visits[pair] += 1
        paid[step] = [0.5 / visits[pair] ** 0.5 for pair in pairs]
    assert np.allclose(rewards[1] - rewards[0], paid, atol=1e-6)
    assert np.array_equal(visits, envs.visits)
    assert np.isin([episode["r"] for episode in model.ep_info_buffer], [-1, 0, 1]).all()  # the true return


def test_advantages_are_sb3s() -> None:
    ours, theirs = twins(TabulatedPPO, PPO, "one_hot", n_steps=STEPS, batch_size=64, gae_lambda=0.9)
    share_rollout(ours, theirs)
    last_values, dones = torch.randn(NUM_ENVS), np.arange(NUM_ENVS) % 2 == 0
    for model in (ours, theirs):
        model.rollout_buffer.compute_returns_and_advantage(last_values.clone(), dones)
    for name in ("advantages", "returns"):
        pair = (getattr(model.rollout_buffer, name) for model in (ours, theirs))
        np.testing.assert_allclose(*pair, rtol=1e-5, atol=1e-6)


def share_replay(ours: Any, theirs: Any) -> None:
    frequency = TrainFreq(STEPS, TrainFrequencyUnit.STEP)
    ours.collect_rollouts(ours.env, no_callback(ours), frequency, ours.replay_buffer)
    source, target = ours.replay_buffer, theirs.replay_buffer
    source.rewards *= 3  # some targets so far away that the Huber loss is linear there
    for name in ("observations", "next_observations"):
        rows = ours.env.observation.rows(getattr(source, name)[:STEPS])
        getattr(target, name)[:STEPS] = rows.reshape(STEPS, NUM_ENVS, *target.obs_shape)
    target.actions[:STEPS] = source.actions[:STEPS, :, None]
    for name in ("rewards", "dones", "timeouts"):
        getattr(target, name)[:STEPS] = getattr(source, name)[:STEPS]
    target.pos = STEPS
    assert source.timeouts.sum() > 0
    assert source.dones.sum() > source.timeouts.sum()
    with torch.no_grad():  # a target network of its own
        targets = (getattr(model, f"{ours.network}_target").parameters() for model in (ours, theirs))
        for mine, peer in zip(*targets, strict=True):
            mine += 0.1 * torch.randn_like(mine)
            peer.copy_(mine)
    ours._target_values = None


FROM_REPLAY: dict[tuple[type, type], list[tuple[str, dict[str, Any]]]] = {
    (TabulatedDQN, DQN): [
        *[(kind, {}) for kind in KINDS],
        ("one_hot", {"max_grad_norm": 1e-3, "gamma": 0.5}),
        ("one_hot", LINEAR),
        *[("coordinates", FOURIER), ("image", CELLS), ("image", PIXELS)],
        ("none", {"policy_kwargs": {"net_arch": [8], "activation_fn": torch.nn.Tanh}}),
        ("one_hot", {"policy_kwargs": {"activation_fn": torch.nn.PReLU}}),
    ],
    (TabulatedQRDQN, QRDQN): [
        *[(kind, {}) for kind in KINDS],
        ("one_hot", {"max_grad_norm": 1e-3, "gamma": 0.5}),
        ("coordinates", FOURIER),
        ("one_hot", {"policy_kwargs": {"net_arch": [], "n_quantiles": 7}}),
        ("none", {"policy_kwargs": {"n_quantiles": 1, "optimizer_class": torch.optim.SGD}}),
    ],
}


@cases(FROM_REPLAY)
def test_updates_from_replay_are_as_stock(
    ours: Any,
    theirs: Any,
    kind: str,
    arguments: dict[str, Any],
    few_states: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tabulated, "_FEW_STATES", few_states)
    steps, size = (1, 64) if few_states else (3, 16)
    if theirs is QRDQN:
        policy_kwargs = {"n_quantiles": 20, **arguments.get("policy_kwargs", {})}
        arguments = {"learning_rate": 1e-3, **arguments, "policy_kwargs": policy_kwargs}
    ours, theirs = twins(ours, theirs, kind, buffer_size=800, exploration_fraction=1.0, **arguments)
    share_replay(ours, theirs)
    assert_same_update(ours, theirs, steps, size)


@pytest.mark.parametrize(("ours", "theirs"), [(TabulatedDQN, DQN), (TabulatedQRDQN, QRDQN)])
def test_the_same_seed_walks_and_learns_the_same(ours: type, theirs: type) -> None:
    """The same random and greedy actions, the same minibatches: the weights agree after as many updates."""
    settings: dict[str, Any] = {"exploration_fraction": 0.5}
    settings |= {"learning_starts": 0, "batch_size": 32, "learning_rate": 0.05, "train_freq": 1}
    settings |= {"buffer_size": 2000, "target_update_interval": 160}
    settings["policy_kwargs"] = {"optimizer_class": torch.optim.SGD}  # Adam would blow rounding up
    pair = [
        cls("MlpPolicy", batch("one_hot"), seed=0, device="cpu", **settings).learn(640)
        for cls in (ours, theirs)
    ]
    observations = pair[0].env.observation.rows(pair[0].replay_buffer.observations[:40])
    assert np.array_equal(observations, pair[1].replay_buffer.observations[:40])
    assert np.array_equal(pair[0].replay_buffer.actions[:40], pair[1].replay_buffer.actions[:40, :, 0])
    for mine, peer in zip(pair[0].policy.parameters(), pair[1].policy.parameters(), strict=True):
        assert torch.allclose(mine, peer, rtol=1e-4, atol=1e-5)


def test_losses_of_several_minibatches_at_once_are_those_of_each() -> None:
    """To the last bit: leading axes are runs of a population, each of which is as it would be alone."""
    quantiles, targets = np.random.default_rng(0).normal(size=(2, 3, 7, 16)).astype(np.float32)
    losses, slopes = qrdqn_losses.losses_and_slopes(quantiles, targets)
    for one, its_targets, loss, its_slopes in zip(quantiles, targets, losses, slopes, strict=True):
        alone, slopes_alone = qrdqn_losses.losses_and_slopes(one, its_targets)
        assert (alone == loss, np.array_equal(slopes_alone, its_slopes)) == (True, True)


def test_dqn_looks_up_a_table_only_while_its_network_stands_still() -> None:
    ours, _ = twins(TabulatedDQN, DQN, "one_hot", buffer_size=800, target_update_interval=10_000)
    ours.exploration_rate = 0.0
    states = np.arange(30)
    before = ours._act(states, 0)
    assert ours._online is not None
    with torch.no_grad():
        expected = ours.q_net(torch.as_tensor(ours.env.observation.table())).argmax(dim=1).numpy()
    assert np.array_equal(before, expected)
    with SideBySide([ours.descent]) as rows:
        off_policy.Update([ours], rows).descend(
            states[None], (expected[None] + 1) % 4, np.full((1, 30), 50, dtype=np.float32)
        )
    assert ours._online is None
    with torch.no_grad():
        expected = ours.q_net(torch.as_tensor(ours.env.observation.table())).argmax(dim=1).numpy()
    assert np.array_equal(ours._act(states, 0), expected)


def test_the_replay_buffer_holds_states_in_the_smallest_type() -> None:
    ours, _ = twins(TabulatedDQN, DQN, "image", buffer_size=800)
    assert ours.replay_buffer.observations.dtype == np.uint8
    assert ours.replay_buffer.observations.shape == (50, NUM_ENVS)
    assert tabulated.smallest_integer(256) == np.uint16


def test_minibatches_drawn_at_once_are_those_drawn_one_by_one() -> None:
    ours, _ = twins(TabulatedDQN, DQN, "one_hot", buffer_size=800)
    ours.learn(400)
    at_once, in_turn = np.random.RandomState(5), np.random.RandomState(5)
    drawn = ours.replay_buffer.draw(3, 7, at_once)
    expected = [ours.replay_buffer.draw(1, 7, in_turn) for _ in range(3)]
    for arrays, parts in zip(drawn, zip(*expected, strict=True), strict=True):
        assert np.array_equal(arrays, np.concatenate(parts))
    steps = [in_turn.randint(0, high, size=7) for high in (ours.replay_buffer.pos, NUM_ENVS)]  # as SB3 draws
    states, *_ = ours.replay_buffer.draw(1, 7, at_once)
    assert np.array_equal(states[0], ours.replay_buffer.observations[*steps])


class Watch(BaseCallback):
    """Looks at what SB3 lets callbacks see."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[str] = []
        self.episodes: list[dict[str, Any]] = []

    def _on_training_start(self) -> None:
        self.calls.append("training start")

    def _on_rollout_start(self) -> None:
        self.calls.append("rollout start")

    def _on_rollout_end(self) -> None:
        self.calls.append("rollout end")

    def _on_step(self) -> bool:
        assert len(self.locals["infos"]) == len(self.locals["rewards"]) == NUM_ENVS
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            assert ("episode" in info) == bool(done)
            self.episodes += [info["episode"]] if done else []
        return self.num_timesteps < 1500


@pytest.mark.parametrize(
    ("ours", "theirs", "arguments"),
    [
        (TabulatedPPO, PPO, {"n_steps": STEPS, "batch_size": 64}),
        (TabulatedA2C, A2C, {"n_steps": 5}),
        (TabulatedTRPO, TRPO, {"n_steps": STEPS, "batch_size": 64}),
        (TabulatedDQN, DQN, {"learning_starts": 100, "exploration_fraction": 1.0}),
        (TabulatedQRDQN, QRDQN, {"learning_starts": 100, "policy_kwargs": {"n_quantiles": 5}}),
    ],
)
def test_callbacks_schedules_and_files_are_sb3s(
    ours: type, theirs: type, arguments: dict[str, Any], tmp_path: Path
) -> None:
    watch = Watch()
    model = ours("MlpPolicy", batch("one_hot"), seed=0, device="cpu", **arguments)
    peer = theirs("MlpPolicy", batch("one_hot"), seed=0, device="cpu", **arguments)
    for one, callback in ((model, watch), (peer, Watch())):
        one.set_logger(Logger(None, [Keep()]))
        one.learn(3000, callback=callback, log_interval=1)
    assert model.num_timesteps == peer.num_timesteps == 1504  # the callback ended it
    counted = len(watch.episodes) - sum(watch.locals["dones"])  # SB3 leaves out the step that ends it all
    assert list(model.ep_info_buffer) == watch.episodes[:counted][-100:]
    assert watch.calls[:2] == ["training start", "rollout start"]
    told, expected = (one.logger.output_formats[0].values.keys() for one in (model, peer))
    assert told == expected

    model.save(tmp_path / "model.zip")
    loaded = theirs.load(tmp_path / "model.zip", device="cpu")
    assert type(loaded) is theirs
    table = model.env.observation.table()
    assert np.array_equal(
        loaded.predict(table, deterministic=True)[0], model.predict(table, deterministic=True)[0]
    )
    loaded.set_env(batch("one_hot"))
    loaded.learn(200, reset_num_timesteps=False)  # and it goes on training


@pytest.mark.parametrize("agent", [*DEEP, "a2c", "qrdqn", "trpo"])
def test_both_engines_train_and_leave_the_same_kind_of_run(agent: str, tmp_path: Path) -> None:
    runs = [
        train_in(tmp_path / engine, *SHORT[agent], f"agent.engine={engine}")
        for engine in ("stock", "tabulated")
    ]
    assert runs[0].keys() == runs[1].keys()
    assert runs[0]["timesteps"] == runs[1]["timesteps"]


OWN_MODULES = """
import torch
from stable_baselines3.dqn.policies import DQNPolicy
from torch import nn

class Calm(nn.Module):  # draws at random, in either mode
    def forward(self, x):
        return x.relu() + 0.1 * torch.randn_like(x)

class Centred(nn.Module):  # looks at the other rows
    def forward(self, x):
        return x - x.mean(dim=0)

class ReLU(nn.ReLU):  # is not what it is called
    def forward(self, x):
        return super().forward(x) + self.training

class Policy(DQNPolicy):
    pass

class Adam(torch.optim.Adam):
    pass
"""


@pytest.fixture
def own_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Makes `own_modules` importable."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "own_modules.py").write_text(OWN_MODULES)
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))
    yield
    sys.modules.pop("own_modules", None)


REASONS = {
    "agent.n_steps=3": "agent.n_steps above 1",
    **{
        f"agent.policy_kwargs.activation_fn={name}": f"agent.policy_kwargs.activation_fn={name} is not known"
        for name in (
            *("torch.nn.RReLU", "torch.nn.Dropout", "torch.nn.Softmax", "own_modules.Calm"),
            *("own_modules.Centred", "own_modules.ReLU"),
        )
    },
    "agent.policy=own_modules.Policy": "agent.policy=own_modules.Policy may compute more",
    "agent.policy_kwargs.optimizer_class=own_modules.Adam": "agent.policy_kwargs.optimizer_class=own_mo",
    "agent.policy_kwargs.optimizer_class=torch.optim.Rprop": "agent.policy_kwargs.optimizer_class=torch",
    "agent.replay_buffer_class=stable_baselines3.common.buffers.ReplayBuffer": (
        "agent.replay_buffer_class is not the plain replay buffer"
    ),
}


@pytest.mark.parametrize(("setting", "reason"), REASONS.items())
@pytest.mark.usefixtures("own_modules")
def test_what_it_does_not_cover_falls_back_and_says_why(
    setting: str, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    config = configure("agent=dqn", setting).agent
    assert isinstance(config, SB3Config)
    assert algorithm_and_arguments(config)[0] is DQN
    assert f"engine: stock, since {reason}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "settings",
    [
        [],
        ["agent.policy_kwargs.activation_fn=torch.nn.modules.activation.GELU"],
        ["agent.policy_kwargs.optimizer_class=torch.optim.adamw.AdamW", "agent.policy_kwargs.net_arch=[]"],
    ],
)
@pytest.mark.parametrize(("agent", "engine"), [("dqn", TabulatedDQN), ("ppo", TabulatedPPO)])
def test_what_is_known_is_covered(agent: str, engine: type, settings: list[str]) -> None:
    config = configure(f"agent={agent}", *settings).agent
    assert isinstance(config, SB3Config)
    assert algorithm_and_arguments(config)[0] is engine


@pytest.mark.parametrize(
    ("agent", "stock", "engine"),
    [("a2c", A2C, TabulatedA2C), ("qrdqn", QRDQN, TabulatedQRDQN), ("trpo", TRPO, TabulatedTRPO)],
)
def test_a_class_with_its_arguments_is_covered_as_well(
    agent: str, stock: type, engine: type, capsys: pytest.CaptureFixture[str]
) -> None:
    def chosen(*settings: str) -> type:
        config = configure(f"agent={agent}", *settings).agent
        assert isinstance(config, SB3Config)
        return algorithm_and_arguments(config)[0]

    without = [f"~agent.arguments.{name}" for name in vars(configure(f"agent={agent}").agent)["arguments"]]
    assert chosen() is engine
    assert chosen("agent.engine=stock") is stock
    assert chosen("agent.algorithm=sb3_contrib.MaskablePPO", *without) is MaskablePPO
    assert capsys.readouterr().err == ""
    assert chosen("+agent.arguments.policy_kwargs.activation_fn=torch.nn.RReLU") is stock
    reason = "agent.arguments.policy_kwargs.activation_fn=torch.nn.RReLU is not known to give"
    assert f"engine: stock, since {reason}" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"agent\.engine=fast: must be tabulated or stock"):
        check(configure(f"agent={agent}", "agent.engine=fast"))


def test_a_policy_of_sb3s_by_its_path_is_covered() -> None:
    for agent, path in (("dqn", "dqn.policies.DQNPolicy"), ("ppo", "common.policies.ActorCriticPolicy")):
        config = configure(f"agent={agent}", f"agent.policy=stable_baselines3.{path}").agent
        assert isinstance(config, SB3Config)
        assert algorithm_and_arguments(config)[0] in (TabulatedDQN, TabulatedPPO)


@pytest.mark.parametrize("kind", tabulated.ACTIVATIONS)
def test_an_activation_that_is_covered_is_a_function_of_each_number(kind: type[torch.nn.Module]) -> None:
    """The same in both modes, alone and among others, time and again, and nothing is drawn."""
    chance, module = torch.get_rng_state(), kind()
    x = torch.linspace(-4, 4, 42).reshape(6, 7)
    expected = module.train()(x)
    for _ in range(2):
        assert torch.equal(module(x), expected)
    module.eval()
    assert torch.allclose(module(x.flip(0).t().contiguous()).t().flip(0), expected, atol=1e-6)
    assert torch.allclose(torch.stack([module(row) for row in x]), expected, atol=1e-6)
    assert torch.equal(torch.get_rng_state(), chance)
    assert not list(module.buffers())
