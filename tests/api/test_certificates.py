"""A score is of what was given: wrappers, every copy of a batch, what `predict` does. Truth is by playing."""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces, wrappers
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from sb3_contrib import MaskablePPO
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import constant_fn
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecExtractDictObs,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

import gridworld
from gridworld import InputError
from gridworld.envs.inspection import task_of

DRAWS = np.random.default_rng(0)  # a generator that wrappers reach as a global
BEST = np.array([1, 2, 1, 0, 1, 0, 1, 0, 2, 1, 1, 0, 0, 2, 2, 0])  # on the dry lake
Make = Callable[[Any], Any]


def lake(**given: Any) -> Any:
    return gym.make("FrozenLake-v1", **{"is_slippery": False, **given})


def grid(**given: Any) -> Any:
    return gym.make("GridWorld-v0", **{"layout": "frozen_lake_4x4", **given})


WORLDS: dict[str, Callable[[], Any]] = {
    "lake": lake,
    "grid": grid,
    "slippery grid": lambda: grid(slip=0.3, step_reward=-0.01, max_episode_steps=40),
    "cliff": lambda: gym.make("CliffWalking-v1", max_episode_steps=30),
}


def state_of(env: Any) -> int:
    base = env.unwrapped
    return int(base.state if isinstance(base, gridworld.GridWorldEnv) else base.s)


# ---- wrappers ----------------------------------------------------------------------------------------------


def own(kind: type, **members: Any) -> Any:
    """A class derived from it."""
    return type("Own", (kind,), members)


def acting(action: Callable[[Any, Any], Any]) -> Any:
    return own(gym.ActionWrapper, action=action)


def paying(reward: Callable[[Any, Any], Any]) -> Any:
    return own(gym.RewardWrapper, reward=reward)


Turned = acting(lambda self, a: (a + 1) % self.env.action_space.n)
Paid = paying(lambda self, r: 2 * float(r) - 0.125)
Shown = own(gym.ObservationWrapper, observation=lambda self, s: self.observation_space.n - 1 - s)
Labelled = own(gym.Wrapper, label="mine", render=lambda self: self.label)  # changes nothing that a step does
Restless = own(
    gym.Wrapper,
    step=lambda self, a: self.env.step(self.action_space.sample() if self.np_random.random() < 0.3 else a),
)


class Fewer(gym.ActionWrapper):
    """Two actions, of which the first is the inner one's last."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.action_space = spaces.Discrete(2)

    def action(self, action: Any) -> Any:
        return 2 - int(action)


class Costly(gym.ObservationWrapper):
    """An observation wrapper by name, and more by its step."""

    def observation(self, observation: Any) -> Any:
        return observation

    def step(self, action: Any) -> Any:
        observation, reward, *others = self.env.step(action)
        return observation, float(reward) - 0.3, *others


class Elsewhere(gym.Wrapper):
    def reset(self, **given: Any) -> Any:
        super().reset(**given)
        self.unwrapped.s = self.unwrapped.state = 2
        return 2, {}


def paid_by(reward: Callable[[Any], Any]) -> Make:
    return lambda env: wrappers.TransformReward(env, reward)


NEUTRAL: dict[str, Make] = {
    "Monitor": Monitor,
    "a Monitor of one's own that steps as it does": own(Monitor, close=lambda self: None),
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "TimeLimit, the shorter of two": lambda env: wrappers.TimeLimit(env, 7),
    "TimeLimit, the longer of two": lambda env: wrappers.TimeLimit(wrappers.TimeLimit(env, 9), 800),
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "a wrapper of one's own that steps as gymnasium.Wrapper": Labelled,
    "masks that nobody asks for": lambda env: ActionMasker(env, lambda _: np.ones(4, dtype=bool)),
}
COMPILED: dict[str, Make] = {
    "turned actions": Turned,
    "actions turned twice": lambda env: Turned(Monitor(Turned(env))),
    "fewer actions": Fewer,
    "TransformAction": lambda env: wrappers.TransformAction(
        env, lambda a: 0 if a == 2 else a, env.action_space
    ),
    "costs": Paid,
    "TransformReward": paid_by(lambda r: -r),
    "ClipReward": lambda env: wrappers.ClipReward(env, -0.5, 0.25),
    "costs around turned actions": lambda env: Paid(Turned(env)),
    "turned actions around costs": lambda env: Turned(wrappers.TimeLimit(Paid(env), 6)),
    "a reversed observation, and costs": lambda env: Shown(Paid(Shown(env))),
}


def with_last_action(env: Any) -> Any:
    return own(
        gym.ObservationWrapper,
        observation=lambda self, s: (s + int(getattr(self.unwrapped, "lastaction", 0) or 0)) % 16,
    )(env)


# fmt: off
CHANGING: dict[str, Make] = {  # whose steps, resets or memory are their own
    "random actions in a step of its own": Restless,
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(env, 2),
    "an action that depends on the state": acting(lambda self, a: 0 if state_of(self) == 1 else a),
    "a reward that depends on the state": paying(lambda self, r: float(r) + (state_of(self) in (4, 8))),
    "an observation wrapper with a step": Costly,
    "a reset of its own": Elsewhere,
    "a neutral one around one that is not": lambda env: Monitor(Restless(env)),
    "one that is not around a neutral one": lambda env: Restless(Monitor(env)),
    "the last action in the observation": with_last_action,
}
# fmt: on


def played(env: Any, act: Callable[[Any], int], episodes: int) -> tuple[float, float]:
    """The mean return of episodes and its standard error; `act` gets the observation."""
    returns = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=1000 + episode)
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return float(np.mean(returns)), float(np.std(returns) / np.sqrt(episodes))


def agrees(score: gridworld.Score, mean: float, error: float) -> bool:
    """Rare ends may be missing from a sample, which the error does not say: 0.03 for these."""
    return abs(score.outcome.expected_return - mean) <= 5 * error + (0.03 if error else 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "kind"),
    [
        *((w, k) for w in ("lake", "slippery grid", "cliff") for k in COMPILED),
        ("grid", "turned actions"),
        *(("lake", k) for k in (*NEUTRAL, *CHANGING)),
        *(("slippery grid", k) for k in list(NEUTRAL)[:4]),
        *(("grid", k) for k in ("RepeatAction", "an action that depends on the state", "a reset of its own")),
    ],
)
def test_the_score_of_a_table_is_what_it_earns_through_wrappers(world: str, kind: str) -> None:
    """The table is by what is shown; in a batch, too."""
    env = {**NEUTRAL, **COMPILED, **CHANGING}[kind](WORLDS[world]())
    states, actions = env.observation_space.n, env.action_space.n
    is_random = "random actions" in kind or "is not" in kind
    rng = np.random.default_rng(3)
    episodes = 200 if is_random or world == "slippery grid" else 1
    for _ in range(2 if episodes == 1 else 1):
        table = rng.integers(actions, size=states)
        score = gridworld.evaluate(table, env)
        mean, error = played(env, lambda seen, table=table: int(table[seen]), episodes)
        assert agrees(score, mean, error or 0.001 * is_random), (
            score,
            mean,
            error,
        )  # rare ends may be missed
    if world == "lake" and kind not in CHANGING:
        vectors = [DummyVecEnv([lambda: env]), SyncVectorEnv([lambda: env])]
        assert all(gridworld.evaluate(table, batch) == score for batch in vectors)
    mdp = gridworld.compile_env(env)
    best = gridworld.Evaluator(mdp, 0.99, 100).optimal_policy()
    assert gridworld.evaluate(best, mdp).certified


@pytest.mark.slow
def test_a_reward_by_running_statistics_is_refused() -> None:
    with pytest.raises(InputError, match=r"^env: .*(return_rms|discounted_reward|reset)"):
        gridworld.compile_env(wrappers.NormalizeReward(lake()), most_seconds=3)


# ---- what else is refused ----------------------------------------------------------------------------------


class Mixing(VecEnvWrapper):
    """Turns the actions of a whole batch."""

    def step_async(self, actions: Any) -> None:
        self.venv.step_async((np.asarray(actions) + 1) % 4)

    def step_wait(self) -> Any:
        return self.venv.step_wait()

    def reset(self) -> Any:
        return self.venv.reset()


def constant(value: float) -> Any:
    """A closure of an installed library."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return constant_fn(value)


class Saving(DummyVecEnv):
    def _save_obs(self, index: int, observation: Any) -> None:
        super()._save_obs(index, 15 - observation)


def native() -> Any:
    return gym.make_vec("GridWorld-v0", 2, layout="frozen_lake_4x4")


def noisy(env: Any) -> Any:
    return wrappers.TransformObservation(
        env, lambda s: (s + (DRAWS.random() < 0.01)) % 16, env.observation_space
    )


def turned_lake() -> Any:
    return Turned(lake())


_BATCH, _ENV = "is not a known batch", "^env: "
# fmt: off
REFUSED: dict[str, tuple[Callable[[], Any], str]] = {  # what makes an environment, and what is said of it
    "one environment in two places":
        (lambda: SyncVectorEnv([functools.cache(lake)] * 2), "the same environment twice"),
    "a batch that mixes": (lambda: Mixing(DummyVecEnv([lake])), _BATCH),
    "our batch that mixes":
        (lambda: VecCheckNan(Mixing(gridworld.make_vec_env(layout="frozen_lake_4x4", n_envs=2))), _BATCH),
    "a batch that pays": (lambda: wrappers.vector.TransformReward(native(), lambda r: -r), _BATCH),
    "a batch that scales": (lambda: wrappers.vector.NormalizeReward(SyncVectorEnv([lake])), _BATCH),
    "a batch that shows otherwise": (lambda: Saving([lake]), _ENV),
    "copies with another function of a library":
        (lambda: DummyVecEnv([lambda k=k: paid_by(constant(k))(lake()) for k in (1, -1)]), "different task"),
    "two rewards": (lambda: paid_by(lambda r: np.array([r, r]))(lake()), _ENV),
    "no reward": (lambda: paid_by(lambda r: None)(lake()), _ENV),
    "an observation that is a word":
        (lambda: wrappers.TransformObservation(lake(), lambda s: "state", spaces.Discrete(16)), _ENV),
    "noise": (lambda: noisy(lake()), _ENV),
}
# fmt: on


@pytest.mark.parametrize("what", REFUSED)
def test_what_may_be_another_task_is_refused(what: str) -> None:
    make, told = REFUSED[what]
    with pytest.raises(InputError, match=told):
        gridworld.evaluate(BEST, make())


def test_a_class_whose_step_is_replaced_is_compared_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    gridworld.evaluate(BEST, lake())
    step = FrozenLakeEnv.step
    monkeypatch.setattr(FrozenLakeEnv, "step", lambda self, action: step(self, (action + 1) % 4))
    turned = gridworld.evaluate(BEST, lake())  # which is found by trying, since its step is not Gymnasium's
    assert not turned.certified
    assert gridworld.evaluate((BEST - 1) % 4, lake()).certified


def test_copies_of_a_batch_must_be_one_task() -> None:
    for other in (Turned, Paid, lambda env: wrappers.TimeLimit(env, 5), lambda env: lake(desc=["SF", "FG"])):
        for batch in (DummyVecEnv, SyncVectorEnv):
            try:
                mixed = batch([lake, lambda other=other: other(lake())])
            except (AssertionError, RuntimeError):
                continue  # refused by the batch itself
            with pytest.raises(InputError, match=r"environment 1 of the .* is a different task"):
                gridworld.evaluate(BEST, mixed)
    for settings in ({"slip": 0.5}, {"step_reward": -0.2}, {"goal_reward": 2.0}):
        for batch in (DummyVecEnv, SyncVectorEnv):
            with pytest.raises(InputError, match="is a different task"):
                gridworld.evaluate(BEST, batch([grid, functools.partial(grid, **settings)]))


def test_environments_that_are_known() -> None:
    vec_envs = [native(), wrappers.vector.RecordEpisodeStatistics(native())]
    for env in (*vec_envs, VecCheckNan(VecMonitor(DummyVecEnv([grid])))):
        assert gridworld.evaluate(BEST, env) == gridworld.evaluate(BEST, grid())
    drawn = own(gridworld.GridWorldEnv, render=lambda self: "otherwise")()
    table = np.ones(30, dtype=int)
    assert gridworld.evaluate(table, drawn) == gridworld.evaluate(table, "classic")


@pytest.mark.slow
def test_environments_in_other_processes_are_refused() -> None:
    for batch in (SubprocVecEnv([turned_lake]), AsyncVectorEnv([turned_lake])):
        with pytest.raises(InputError, match="in other processes, where their wrappers cannot be inspected"):
            gridworld.evaluate(BEST, batch)
        batch.close()


# ---- models ------------------------------------------------------------------------------------------------


def lake_model(env: Any) -> Any:
    exploring = {"learning_starts": 200, "exploration_fraction": 0.5, "buffer_size": 3000}
    return DQN("MlpPolicy", env, gamma=0.9, learning_rate=0.01, seed=1, device="cpu", **exploring)


def test_an_observation_that_is_drawn_elsewhere_is_refused() -> None:
    model = lake_model(noisy(lake()))
    for env in (None, noisy(lake())):
        with pytest.raises(InputError, match=r"(does not repeat a walk|draws from another generator)"):
            gridworld.evaluate(model, env)


def as_coordinates(env: Any) -> Any:
    space = spaces.Box(0, 1, (2,), np.float32)
    return wrappers.TransformObservation(env, lambda s: np.array([s // 4, s % 4], np.float32) / 3, space)


def as_dict() -> Any:
    space = spaces.Dict({"place": spaces.Box(0, 1, (2,), np.float32), "rest": spaces.Discrete(3)})
    return wrappers.TransformObservation(
        lake(), lambda s: {"place": np.array([s // 4, s % 4], np.float32) / 3, "rest": 1}, space
    )


def pixels() -> Any:
    def drawn(state: Any) -> Any:
        image = np.zeros((8, 8, 3), np.uint8)
        image.ravel()[state::17] = 255
        return image

    return wrappers.TransformObservation(lake(), drawn, spaces.Box(0, 255, (8, 8, 3), np.uint8))


def flat_lake() -> Any:
    return wrappers.FlattenObservation(lake())


SEEN: dict[str, Callable[[], Any]] = {
    "reversed": lambda: Shown(lake()),
    "one-hot": flat_lake,
    "reversed behind turned actions": lambda: Turned(Shown(lake())),
    "a row of numbers": lambda: as_coordinates(lake()),
    "an entry of a Dict": lambda: VecExtractDictObs(DummyVecEnv([as_dict]), "place"),
    "normalised": lambda: VecNormalize(DummyVecEnv([flat_lake])),
    "pixels": lambda: VecTransposeImage(DummyVecEnv([pixels])),
    "a mixture of batches": lambda: VecMonitor(
        VecNormalize(VecExtractDictObs(DummyVecEnv([as_dict] * 2), "place"))
    ),
    "grid coordinates": lambda: gridworld.CoordinateObservation(grid()),
    "grid images": lambda: gridworld.ImageObservation(grid(), cell_size=9),
    "our batch": lambda: VecCheckNan(gridworld.make_vec_env(layout="frozen_lake_4x4", n_envs=3)),
}


def played_by(model: Any, env: Any) -> float:
    """The undiscounted return of an episode of the first environment of what it was trained on."""
    batch = env if hasattr(env, "step_wait") else DummyVecEnv([lambda: env])
    batch.training = False
    observation, total, done = batch.reset(), 0.0, [False]
    while not done[0]:
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, done, _ = batch.step(action)
        total += float(batch.get_original_reward()[0] if hasattr(batch, "get_original_reward") else reward[0])
    return total


@pytest.mark.slow
@pytest.mark.parametrize("kind", SEEN)
def test_a_model_is_scored_by_what_it_is_shown(kind: str) -> None:
    env = SEEN[kind]()
    for seed in range(2):
        model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=seed, device="cpu")
        score = gridworld.evaluate(model, env)
        assert score == gridworld.evaluate(model, model.get_env()) == gridworld.evaluate(model)
        assert score.outcome.expected_return == pytest.approx(played_by(model, env), abs=1e-6)
        for training in (True, False):  # is left as it was
            model.policy.set_training_mode(training)
            gridworld.evaluate(model)
            assert model.policy.training is training


def test_a_model_behind_turned_actions_is_certified_for_what_it_earns() -> None:
    env = Turned(lake(desc=["SF", "HG"]))
    callback = gridworld.ExactEvalCallback(every=200, stop_after=1)
    model = lake_model(env).learn(4000, callback=callback)
    score = gridworld.evaluate(model)
    assert score.certified
    assert callback.evaluations["certified"][-1]
    assert score.outcome.expected_return == played_by(model, env) == 1
    assert not gridworld.evaluate(model, lake(desc=["SF", "HG"])).certified


# ---- a predict of its own ----------------------------------------------------------------------------------


def predicting(act: Callable[[Any], Any], base: type = DQN) -> type:
    """A class whose `predict` changes the actions."""

    def predict(self: Any, observation: Any, *given: Any, **named: Any) -> Any:
        actions, state = base.predict(self, observation, *given, **named)  # type: ignore[attr-defined]
        return act(actions), state

    return type("Own", (base,), {"predict": predict})


def fail(actions: Any) -> Any:
    raise ValueError("no actions today")


class Sampling(PPO):
    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, **named: Any) -> Any:
        return super().predict(observation, state, episode_start, deterministic=False)


class Clock(PPO):
    def predict(self, observation: Any, state: Any = None, *args: Any, **named: Any) -> Any:
        actions, _ = super().predict(observation, None, *args, **named)
        return actions, 0 if state is None else state + 1


Rotating = predicting(lambda actions: (actions + 1) % 4)
REFUSED_PREDICTS = {
    "draws random numbers": predicting(lambda a: (a + np.random.randint(0, 4, np.shape(a))) % 4),
    "always take the same action": predicting(lambda a: np.full_like(a, a if np.ndim(a) == 0 else a[0])),
    "raised": predicting(fail),
}


def test_a_predict_of_its_own_is_what_is_scored() -> None:
    env, differ = grid(step_reward=-0.1), False
    for seed in range(3):
        plain, rotating = (kind("MlpPolicy", env, buffer_size=10, seed=seed) for kind in (DQN, Rotating))
        for model in (plain, rotating):
            assert gridworld.evaluate(model).outcome.expected_return == pytest.approx(played_by(model, env))
        differ |= gridworld.evaluate(plain) != gridworld.evaluate(rotating)
        plain.predict = rotating.predict
        assert gridworld.evaluate(plain) == gridworld.evaluate(rotating)
    assert differ
    with pytest.raises(InputError, match=r"has its own predict\(\), so its exploring"):
        gridworld.evaluate(rotating, deterministic=False)
    for told, kind in REFUSED_PREDICTS.items():
        with pytest.raises(InputError, match=told):
            gridworld.evaluate(kind("MlpPolicy", env, buffer_size=10, seed=0))


def held(table: Any, env: Any = None) -> Any:
    """A model of the lake, shown one-hot, that acts by a table (16,)."""
    model = PPO("MlpPolicy", env or flat_lake(), policy_kwargs={"net_arch": []}, device="cpu")
    with torch.no_grad():
        model.policy.action_net.weight[:] = 20 * torch.as_tensor(np.eye(4)[table].T)
        model.policy.action_net.bias[:] = 0
    return model


@pytest.mark.parametrize(
    ("kind", "told"), [(Sampling, "draws random numbers"), (Clock, "keeps a state between steps")]
)
def test_a_predict_that_draws_or_keeps_time_is_refused(kind: type, told: str) -> None:
    model = held(BEST)
    model.__class__ = kind
    with pytest.raises(InputError, match=told):
        gridworld.evaluate(model, flat_lake())


# ---- masks -------------------------------------------------------------------------------------------------


def only_left(env: Any) -> Any:
    return ActionMasker(env, lambda _: np.array([True, False, False, False]))


def never_back(env: Any) -> Any:
    """Forbids up in the first row and left in the first column."""

    def allowed(inner: Any) -> Any:
        row, column = divmod(inner.unwrapped.s, 4)
        return np.array([column > 0, True, True, row > 0])

    return ActionMasker(env, allowed)


@pytest.mark.slow
@pytest.mark.parametrize("masking", [only_left, never_back])
def test_a_model_with_masks_is_scored_with_them(masking: Any) -> None:
    for seed in range(6):
        env = masking(lake())
        model = MaskablePPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=seed, device="cpu")

        def act(observation: Any, model: Any = model, env: Any = env) -> int:
            return int(model.predict(observation, deterministic=True, action_masks=env.action_masks())[0])

        score = gridworld.evaluate(model)
        assert (score.outcome.expected_return, 0) == played(env, act, 1)
        sampled = gridworld.evaluate(model, env, deterministic=False)
        if masking is only_left:
            assert (score.value, sampled.value, sampled.outcome.timeout) == (0, 0, 1)
    random_masks = ActionMasker(lake(), lambda _: DRAWS.random(4) < 0.9)
    with pytest.raises(InputError, match=r"action_masks\(\) does not always allow the same"):
        gridworld.evaluate(model, random_masks)


def forbidding(action: int) -> Any:
    return own(gym.Wrapper, action_masks=lambda self: np.arange(4) != action)(lake())


class Forwarding(MaskablePPO):
    def predict(self, *args: Any, **named: Any) -> Any:
        return super().predict(*args, **named)


def test_masks_that_differ_between_copies_are_refused() -> None:
    batch = DummyVecEnv([lambda: forbidding(0), lambda: forbidding(1)])
    with pytest.raises(InputError, match="masks actions differently"):
        gridworld.evaluate(MaskablePPO("MlpPolicy", batch, n_steps=8, device="cpu"))
    one, two = (
        kind("MlpPolicy", forbidding(1), n_steps=8, seed=3, device="cpu")
        for kind in (MaskablePPO, Forwarding)
    )
    assert gridworld.evaluate(one) == gridworld.evaluate(two)


# ---- observations ------------------------------------------------------------------------------------------


class Six(gym.Env):
    """Six states in a row, whose last pays on some ways in."""

    observation_space, action_space = spaces.Discrete(6), spaces.Discrete(2)
    P = {  # noqa: RUF012
        s: {
            0: [(1.0, max(s - 1, 0), 0.0, False)],
            1: [(0.5, min(s + 1, 5), float(s == 4), s == 4), (0.5, max(s - 1, 0), 0.0, s == 3)],
        }
        for s in range(6)
    }
    initial_state_distrib = np.eye(6)[0]

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.s = 0
        return 0, {}

    def step(self, action: Any) -> Any:
        row = self.P[self.s][int(action)]
        _, self.s, reward, over = row[int(self.np_random.random() > row[0][0])] if len(row) > 1 else row[0]
        return self.s, reward, over, False, {}


def test_a_table_may_be_by_what_the_environment_shows() -> None:
    env = wrappers.TimeLimit(Six(), 30)
    assert gridworld.compile_env(env).num_states > 6  # than are shown
    for table in ([1] * 6, [1, 1, 0, 1, 1, 1]):
        score = gridworld.evaluate(table, env)
        assert agrees(score, *played(env, functools.partial(lambda table, s: table[s], table), 400))
        by_rows = gridworld.evaluate(np.eye(2)[table], env)
        assert by_rows == score == gridworld.evaluate(q=np.eye(2)[table], env=env)
    assert gridworld.evaluate(BEST[::-1], Shown(lake())).certified
    assert not gridworld.evaluate(BEST, Shown(lake())).certified
    with pytest.raises(InputError, match="by which no table has rows"):
        gridworld.evaluate(BEST, flat_lake())


def test_a_table_behind_a_delay_acts_on_what_is_shown_late() -> None:
    late = wrappers.DelayObservation(lake(), 1)
    score = gridworld.evaluate(BEST, late)
    assert score.outcome.expected_return == played(late, lambda seen: int(BEST[seen]), 1)[0]
    assert not score.certified
    assert gridworld.Evaluator(gridworld.compile_env(late), 0.99, 100).optimum.goal == 1


def test_observations_are_what_a_batch_makes_of_them() -> None:
    def halves(dtype: Any) -> Any:
        space = spaces.Box(0, 1, (16,), dtype)
        return wrappers.TransformObservation(lake(), lambda s: np.eye(16)[s] * 0.5, space)

    assert gridworld.evaluate(held(BEST, halves(np.float32))).certified
    model = PPO("MlpPolicy", halves(np.uint8), device="cpu")
    with pytest.raises(InputError, match=r"an observation is .* not in its space"):
        gridworld.evaluate(model)


def test_a_replaced_observation_is_what_is_seen() -> None:
    env = gridworld.OneHotObservation(gridworld.GridWorldEnv())
    seen = task_of(env).seen
    assert seen is not None
    assert seen() is env.table
    env.observation = lambda state: np.zeros(30, np.float32)  # type: ignore[method-assign]
    seen = task_of(env).seen
    assert seen is not None
    assert not seen().table().any()


class Buffered(gym.ObservationWrapper):
    """Writes to one array, as many do."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.observation_space = spaces.Box(0, 1, (16,), np.float32)
        self.buffer = np.zeros(16, np.float32)

    def observation(self, observation: Any) -> Any:
        self.buffer[:] = 0
        self.buffer[observation] = 1
        return self.buffer


def test_a_buffer_is_no_memory() -> None:
    assert gridworld.evaluate(held(BEST, Buffered(lake()))).certified


def test_an_encoding_of_ones_own_is_not_taken_for_ours_by_its_space() -> None:
    def reversed_rows() -> Any:
        space = spaces.Box(0, 1, (16,), np.float32)
        return wrappers.TransformObservation(grid(), lambda s: np.eye(16, dtype=np.float32)[15 - s], space)

    model = held(BEST, reversed_rows())
    for other in (grid(), gridworld.load("frozen_lake_4x4"), gridworld.compile_env(reversed_rows())):
        with pytest.raises(InputError, match="merely has the same space"):
            gridworld.evaluate(model, other)
    ours = held(BEST, gridworld.OneHotObservation(grid()))
    assert gridworld.evaluate(ours, gridworld.load("frozen_lake_4x4")) == gridworld.evaluate(ours)


# ---- what changes on the way -------------------------------------------------------------------------------


def test_a_world_stays_what_it_was_made_as() -> None:
    env, batch = grid(), gym.make_vec("GridWorld-v0", 2, max_episode_steps=9)
    for each in (env.unwrapped, batch):
        with pytest.raises(AttributeError):
            each.mdp = gridworld.compile_mdp(gridworld.load("classic"), slip=0.4)
    batch.max_episode_steps = 3  # has no effect on its steps
    assert gridworld.evaluate(np.zeros(30, dtype=int), batch).outcome.expected_length == 9


def test_a_callback_follows_the_environment_that_a_model_is_given() -> None:
    callback = gridworld.ExactEvalCallback(every=64)
    model = PPO("MlpPolicy", gridworld.OneHotObservation(grid()), n_steps=64, device="cpu")
    model.learn(64, callback=callback)
    model.set_env(gridworld.OneHotObservation(grid(slip=0.3, step_reward=-0.1)))
    model.learn(64, callback=callback)
    assert callback.evaluations["value"][-1] == gridworld.evaluate(model).value


def test_a_callback_keeps_the_statistics_of_its_own_environment_like_those_of_training() -> None:
    callback = gridworld.ExactEvalCallback(SEEN["normalised"](), every=64)
    model = PPO("MlpPolicy", SEEN["normalised"](), n_steps=64, seed=0, device="cpu")
    model.learn(256, callback=callback)
    assert callback.evaluations["value"][-1] == gridworld.evaluate(model).value


class Times(gym.RewardWrapper[Any, Any]):
    """Its attribute has the name of one of SB3's Monitor, which says where an episode is."""

    def __init__(self, env: Any, rewards: float) -> None:
        super().__init__(env)
        self.rewards = rewards

    def reward(self, reward: Any) -> float:
        return self.rewards * float(reward)


def test_copies_that_differ_in_a_custom_attribute_are_refused() -> None:
    copies = DummyVecEnv([lambda: Times(lake(), 1.0), lambda: Times(lake(), -1.0)])
    with pytest.raises(InputError, match="environment 1 of the DummyVecEnv is a different task"):
        gridworld.evaluate(np.ones(16, dtype=int), copies)
    alike = DummyVecEnv([lambda: Times(lake(), 2.0)] * 2)
    assert gridworld.evaluate(np.ones(16, dtype=int), alike).regret == pytest.approx(2 * 0.99**5)
