"""An update of the engine is Stable-Baselines3's: the same weights and logged values, to rounding."""

import copy
from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.logger import Logger

from gridworld.agents.sb3.features import AgentByColour, FourierFeatures, PixelCNN
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.engine import dqn, on_policy, population
from gridworld.engine.population import Run
from gridworld.engine.sb3_format import algorithm_of, make_run, put_weights
from gridworld.envs.observations import make_observation
from gridworld.envs.training_env import TrainingVectorEnv

NUM_ENVS, STEPS = 16, 32
KINDS = ["one_hot", "coordinates", "none", "image"]


def twins(algorithm: type, kind: str, step_limit: int = 12, **arguments: Any) -> tuple[Run, Any]:
    """A run of the engine and SB3's model with the same weights and generators, in a slippery world."""
    envs = TrainingVectorEnv(NUM_ENVS, slip=0.2, max_episode_steps=step_limit)
    observation = make_observation(envs.mdp, kind)
    policy = "CnnPolicy" if kind == "image" else "MlpPolicy"
    models = []
    for _ in range(2):
        model = algorithm(
            policy, GridWorldVecEnv(envs, observation), seed=0, device="cpu", **copy.deepcopy(arguments)
        )
        model.set_logger(Logger(None, []))
        model._setup_learn(10_000)
        models.append(model)
    models[1].policy.load_state_dict(models[0].policy.state_dict())
    run = make_run(models[0], observation, envs, 0)
    run.begin(10_000)
    found = algorithm_of(algorithm)
    assert found is not None
    found([run], [None])
    return run, models[1]


def move_away(run: Run, theirs: Any) -> None:
    """Let the update begin away from the policy that collected."""
    weights = run.population.networks.weights
    with torch.no_grad():
        weights += 0.05 * torch.randn(weights.shape, generator=torch.Generator().manual_seed(3))
    run.population.networks.run()
    put_weights(run)
    theirs.policy.load_state_dict(run.model.policy.state_dict())


def samples(run: Run, count: int) -> tuple[Any, Any, Any, Any]:
    """States, actions, advantages and returns of so many samples."""
    rng, mdp = np.random.default_rng(1), run.envs.mdp
    states, actions = rng.integers(mdp.num_states, size=count), rng.integers(mdp.num_actions, size=count)
    return states, actions, *rng.normal(size=(2, count)).astype(np.float32)


def assert_same(run: Run, theirs: Any) -> None:
    """Weights and all that was logged agree to rounding."""
    put_weights(run)
    for mine, peer in zip(run.model.policy.parameters(), theirs.policy.parameters(), strict=True):
        assert torch.allclose(mine, peer, rtol=1e-5, atol=1e-6)
    logged, expected = (
        {key: value for key, value in model.logger.name_to_value.items() if key.startswith("train/")}
        for model in (run.model, theirs)
    )
    of_the_rollout = {"train/explained_variance", "train/n_updates", "train/learning_rate"}
    assert logged.keys() | of_the_rollout >= expected.keys()
    for key in expected.keys() - of_the_rollout:
        assert logged[key] == pytest.approx(expected[key], rel=1e-4, abs=1e-6), key


SEPARATE = {"policy_kwargs": {"share_features_extractor": False}}
FOURIER = {"policy_kwargs": {"features_extractor_class": FourierFeatures}}
CELLS = {"policy_kwargs": {"features_extractor_class": AgentByColour, "net_arch": [16]}}
# Where a square is the same in an image everywhere, rounding is what is scaled to variance 1: no Adam here.
SGD = {"optimizer_class": torch.optim.SGD}
PIXELS = {"policy_kwargs": {"features_extractor_class": PixelCNN, "net_arch": [16], **SGD}}
APART = {"policy_kwargs": {**FOURIER["policy_kwargs"], "share_features_extractor": False}}
LINEAR: dict[str, Any] = {"policy_kwargs": {"net_arch": []}}
TWO_SIZES = {"policy_kwargs": {"net_arch": {"pi": [8], "vf": [16, 16]}}}
# RMSprop's first steps are of full size, however small a gradient is: with its own eps rounding would grow.
RMSPROP = {"optimizer_class": torch.optim.RMSprop, "optimizer_kwargs": {"eps": 1e-3}}
RELU = {"policy_kwargs": {"activation_fn": torch.nn.ReLU, **RMSPROP}}
ELU = {"policy_kwargs": {"activation_fn": torch.nn.ELU}}
COEFFICIENTS = {"ent_coef": 0.3, "vf_coef": 0.1, "max_grad_norm": 0.01}
NETWORKS: list[tuple[str, dict[str, Any]]] = [
    *[(kind, {}) for kind in KINDS],
    *[("none", LINEAR), ("coordinates", TWO_SIZES), ("coordinates", SEPARATE), ("image", SEPARATE)],
    *[("coordinates", FOURIER), ("coordinates", APART), ("image", CELLS), ("image", PIXELS)],
    *[("one_hot", RELU), ("one_hot", ELU)],
]
ON_POLICY: list[tuple[type, str, dict[str, Any]]] = [
    *[(PPO, kind, arguments) for kind, arguments in NETWORKS],
    (PPO, "one_hot", {"clip_range": 0.02, "normalize_advantage": False, **COEFFICIENTS}),
    (PPO, "one_hot", {"clip_range_vf": 0.05}),
    (PPO, "one_hot", {"target_kl": 4.4e-3, "n_epochs": 3}),  # which ends before the fourth minibatch
    (PPO, "one_hot", {"n_epochs": 3, "batch_size": 100}),
    (PPO, "one_hot", {"n_epochs": 3, "batch_size": 10_000}),
    *[(A2C, "one_hot", {}), (A2C, "coordinates", TWO_SIZES), (A2C, "image", PIXELS)],
    (A2C, "one_hot", {"normalize_advantage": True, "use_rms_prop": False, **COEFFICIENTS}),
]


@pytest.mark.parametrize("few_states", [1024, 0], ids=["all states", "distinct states"])
@pytest.mark.parametrize(("algorithm", "kind", "arguments"), ON_POLICY, ids=str)
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size of")
def test_updates_from_rollouts(
    algorithm: Any, kind: str, arguments: dict[str, Any], few_states: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (population, on_policy):
        monkeypatch.setattr(module, "FEW_STATES", few_states)
    n_steps = STEPS
    if algorithm is PPO:
        arguments = {"n_epochs": 1, "batch_size": 256, **arguments}
        if few_states == 0:  # many updates follow each other, in which Adam would blow rounding up
            kwargs = {**SGD, "optimizer_kwargs": {}, **arguments.get("policy_kwargs", {})}
            fewest = 16 if kind != "image" else 64  # each takes long
            arguments |= {"batch_size": min(fewest, arguments["batch_size"]), "policy_kwargs": kwargs}
    elif few_states == 0:
        n_steps = 1  # fewer samples than states
    run, theirs = twins(algorithm, kind, n_steps=n_steps, **arguments)
    states, actions, advantages, returns = samples(run, n_steps * NUM_ENVS)
    logits, values = run.population.outputs
    log_prob = on_policy.log_softmax(logits)
    buffer, shape = theirs.rollout_buffer, (NUM_ENVS, n_steps)  # samples are environment by environment
    buffer.observations = run.network.rows(states).reshape(*shape, *buffer.obs_shape).swapaxes(0, 1)
    buffer.actions = actions.reshape(shape).T[..., None]
    for name, table in (
        ("values", values[0, states]),
        ("log_probs", log_prob[0, states, actions]),
        ("advantages", advantages),
        ("returns", returns),
    ):
        setattr(buffer, name, table.reshape(shape).T.copy())
    buffer.full = True
    move_away(run, theirs)
    np.random.set_state(run.numpy_generator.get_state())
    torch.set_rng_state(run.torch_generator.get_state())
    theirs.train()
    run.population.update((log_prob, values), (states * 4 + actions)[None], advantages[None], returns[None])
    assert run.error is None
    assert_same(run, theirs)


OFF_POLICY: list[tuple[type, str, dict[str, Any]]] = [
    *[(DQN, kind, {}) for kind in KINDS],
    (DQN, "one_hot", {"max_grad_norm": 1e-3, "gamma": 0.5}),
    *[(DQN, "one_hot", LINEAR), (DQN, "coordinates", FOURIER), (DQN, "image", CELLS), (DQN, "image", PIXELS)],
    (DQN, "none", {"policy_kwargs": {"net_arch": [8], "activation_fn": torch.nn.Tanh}}),
    (DQN, "one_hot", {"policy_kwargs": {"activation_fn": torch.nn.PReLU}}),
    *[(QRDQN, "one_hot", {"max_grad_norm": 1e-3, "gamma": 0.5}), (QRDQN, "coordinates", FOURIER)],
    (QRDQN, "image", {"policy_kwargs": {"net_arch": [], "n_quantiles": 7}}),
    (QRDQN, "none", {"policy_kwargs": {"n_quantiles": 1, **SGD}}),
]


@pytest.mark.parametrize("few_states", [1024, 0], ids=["all states", "distinct states"])
@pytest.mark.parametrize(("algorithm", "kind", "arguments"), OFF_POLICY, ids=str)
def test_updates_from_replay(
    algorithm: Any, kind: str, arguments: dict[str, Any], few_states: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (population, dqn):
        monkeypatch.setattr(module, "FEW_STATES", few_states)
    steps, size = (1, 64) if few_states else (3, 16)
    if algorithm is QRDQN:
        policy_kwargs = {"n_quantiles": 20, **arguments.get("policy_kwargs", {})}
        arguments = {"learning_rate": 1e-3, **arguments, "policy_kwargs": policy_kwargs}
    if few_states == 0:  # updates follow each other, in which Adam would blow rounding up
        arguments |= {"policy_kwargs": {**SGD, **arguments.get("policy_kwargs", {})}, "learning_rate": 0.01}
    run, theirs = twins(algorithm, kind, buffer_size=800, batch_size=size, **arguments)
    ours: Any = run.population
    rng, buffer = np.random.default_rng(1), theirs.replay_buffer
    for _ in range(STEPS):
        states, following = rng.integers(30, size=(2, NUM_ENVS))
        actions, rewards = rng.integers(4, size=NUM_ENVS), 3 * rng.normal(size=NUM_ENVS)
        dones, cut = rng.random((2, NUM_ENVS)) < 0.3
        ours.replay.store(*(each[None] for each in (states, actions, following, rewards, dones & ~cut)))
        infos = [{"TimeLimit.truncated": bool(each)} for each in cut]
        rows = [run.network.rows(each) for each in (states, following)]
        buffer.add(*rows, actions, rewards, dones, infos)
    with torch.no_grad():  # a target network of its own
        ours.target.weights += 0.1 * torch.randn_like(ours.target.weights)
    move_away(run, theirs)
    np.random.set_state(run.numpy_generator.get_state())
    theirs.train(steps, size)
    ours._update(steps)
    assert run.error is None
    assert_same(run, theirs)


@pytest.mark.parametrize("algorithm", [DQN, QRDQN])
def test_the_same_seed_walks_and_learns_the_same(algorithm: Any) -> None:
    """The same random and greedy actions, the same minibatches: the weights agree after as many updates."""
    settings: dict[str, Any] = {
        "exploration_fraction": 0.5,
        "buffer_size": 2000,
        "target_update_interval": 160,
    }
    settings |= {"learning_starts": 0, "batch_size": 32, "learning_rate": 0.05, "train_freq": 1}
    run, theirs = twins(algorithm, "one_hot", **settings, policy_kwargs=SGD)
    run.total_timesteps = 640
    population.train([run], [None])
    theirs = algorithm("MlpPolicy", theirs.env, seed=0, device="cpu", **settings, policy_kwargs=SGD)
    theirs.learn(640)
    put_weights(run)
    for mine, peer in zip(run.model.policy.parameters(), theirs.policy.parameters(), strict=True):
        assert torch.allclose(mine, peer, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("algorithm", [PPO, A2C, DQN, QRDQN])
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size of")
def test_only_the_states_within_the_step_limit_learn(algorithm: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a large world, what is never met keeps its weights, and the others learn as if all could."""
    for module in (population, dqn, on_policy):
        monkeypatch.setattr(module, "FEW_STATES", 0)
    off_policy = algorithm in (DQN, QRDQN)
    settings = {"learning_starts": 0, "buffer_size": 800, "train_freq": 2} if off_policy else {"n_steps": 8}
    settings |= {"batch_size": 16} if algorithm is not A2C else {}

    def learner(steps: int, state: Any = None) -> Run:
        run, _ = twins(algorithm, "one_hot", step_limit=3, **settings)
        run.total_timesteps = steps
        population.train([run], [state])
        assert run.error is None
        put_weights(run)
        return run

    def weights(run: Run) -> list[Any]:
        optimizer = run.model.policy.optimizer.state_dict()["state"]
        moments = [each for state in optimizer.values() for each in state.values()]
        return [each.detach().clone() for each in (*run.model.policy.parameters(), *moments)]

    made, half, whole = learner(0), learner(256), learner(512)
    met = whole.met
    assert met is not None
    assert 0 < len(met) < 30 / 2
    nets: Any = whole.population.networks
    assert nets.weights.shape[1] < nets.whole().shape[1]
    unmet = np.delete(np.arange(30), met)
    firsts = [
        (net[0].weight, before[0].weight)
        for net, before in zip(whole.network.layers, made.network.layers, strict=True)
    ]
    for first, before in firsts:
        assert torch.equal(first[:, unmet], before[:, unmet])
        assert not torch.equal(first[:, met], before[:, met])
    resumed = learner(512, half.population.get_state(half))
    assert all(map(torch.equal, weights(resumed), weights(whole)))
    _, probabilities, q = whole.population.snapshot(whole)  # of all states
    assert np.abs((q if off_policy else probabilities)[unmet]).all()  # type: ignore[index]
    monkeypatch.setattr(Run, "met", None)
    for mine, peer in zip(weights(whole), weights(learner(512)), strict=True):
        assert torch.allclose(mine, peer, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_rollouts_and_advantages_are_sb3s(algorithm: Any) -> None:
    """SB3's own recursion over the rewards, values and ends of a rollout, and its values at time-outs."""
    run, theirs = twins(algorithm, "one_hot", n_steps=STEPS, gae_lambda=0.9)
    ours: Any = run.population
    found: dict[str, Any] = {}
    roll = ours.environments.roll

    def rolled(*arguments: Any) -> Any:
        found["rollout"] = roll(*arguments)
        return found["rollout"]

    ours.environments.roll = rolled
    ours.update = lambda *arguments: found.update(samples=arguments)
    _, values = ours.outputs
    ours.iterate()
    rollout, (_, _, advantages, returns) = found["rollout"], found["samples"]
    buffer, states = theirs.rollout_buffer, rollout.pairs[:, 0] // 4
    ends = (rollout.terminated | rollout.truncated)[:, 0]
    assert ends.sum() > rollout.truncated.sum() > 0
    buffer.values = values[0][states]
    cut = rollout.truncated[:, 0] * theirs.gamma * values[0][rollout.reached[:, 0]]
    buffer.rewards = (rollout.rewards[:, 0] + cut).astype(np.float32)
    buffer.episode_starts = np.concatenate([np.ones((1, NUM_ENVS)), ends[:-1]]).astype(np.float32)
    last = torch.as_tensor(values[0][rollout.final_states[0]])
    buffer.compute_returns_and_advantage(last, ends[-1])
    for name, table in (("advantages", advantages), ("returns", returns)):
        assert np.allclose(getattr(buffer, name).T.ravel(), table[0], rtol=1e-5, atol=1e-6)
