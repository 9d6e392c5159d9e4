"""What an environment shows, as a learner gets it, and as a file keeps it."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage

from gridworld.base.errors import InputError
from gridworld.world.door.world import enumerated
from gridworld.world.shown import channels_first, misfit, of_learners, space_of_text, space_text
from gridworld.world.sources.arrays import world_bytes, world_from_bytes

PLACE = spaces.Box(0, 4, (2,), np.int64)
SPACES: dict[str, gym.Space[Any]] = {
    "box": spaces.Box(-np.inf, np.inf, (3,), np.float32),
    "uneven": spaces.Box(np.array([0.1, -2.0]), np.array([1.5, np.inf]), dtype=np.float64),
    "none": spaces.Box(0, 1, (0,), np.float32),
    "scalar": spaces.Box(0.0, 1.0, (), np.float32),
    "pixels": spaces.Box(0, 255, (5, 4, 3), np.uint8),
    "dark": spaces.Box(0, 9, (5, 4, 3), np.uint8),
    "number": spaces.Discrete(5),
    "numbers": spaces.MultiDiscrete([2, 3]),
    "square": spaces.MultiDiscrete(np.array([[2, 3], [4, 5]])),
    "flags": spaces.MultiBinary(4),
    "board": spaces.MultiBinary([2, 2]),
    "dict": spaces.Dict(
        {"b": PLACE, "a": spaces.Discrete(3), "c": spaces.Box(0, 255, (40, 36, 3), np.uint8)}
    ),
}


class Showing(gym.Env[Any, int]):
    """Three states in a row, each of which shows a sample of the space."""

    def __init__(self, space: gym.Space[Any]) -> None:
        self.observation_space, self.action_space = space, spaces.Discrete(2)
        space.seed(3)
        self.samples = [space.sample() for _ in range(3)]

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.at = 0
        return self.samples[0], {}

    def step(self, action: int) -> Any:
        self.at = min(self.at + int(action), 2)
        return self.samples[self.at], float(action), self.at == 2, False, {}


@pytest.mark.parametrize("name", SPACES)
def test_what_is_learned_from_is_what_sb3_makes_of_the_environment(name: str) -> None:
    env = Showing(SPACES[name])
    mdp = enumerated("env", env)
    assert mdp.mdp.own_space == env.observation_space
    space, rows = channels_first(mdp.mdp.own_space, mdp.mdp.own_observation)
    venv: Any = DummyVecEnv([lambda: env])
    policy = "MultiInputPolicy" if name == "dict" else "MlpPolicy"
    if name not in ("none", "scalar", "square", "board"):  # which SB3 has no networks for
        model = PPO(policy, venv, n_steps=2, batch_size=2)
        assert model.observation_space == space
    if space != env.observation_space:
        venv = VecTransposeImage(venv)
    first, shown = int(mdp.mdp.start_states[0]), venv.reset()
    for key in shown if isinstance(shown, dict) else [None]:
        one, other = (shown, rows) if key is None else (shown[key], rows[key])
        assert np.array_equal(one[0], other[first])
        assert one.dtype == other.dtype


@pytest.mark.parametrize("name", SPACES)
def test_a_file_keeps_it(name: str) -> None:
    mdp = enumerated("env", Showing(SPACES[name])).mdp
    content = world_bytes(mdp)
    again = world_from_bytes(content, "world.npz")
    assert again.own_space == mdp.own_space
    assert world_bytes(again) == content
    assert space_of_text(space_text(mdp.own_space), "") == mdp.own_space


def test_what_sb3_has_no_space_for() -> None:
    shifted = of_learners(spaces.Discrete(3, start=1), np.array([1, 2, 3]))
    assert shifted[0] is None
    assert shifted[1].tolist() == [1, 2, 3]
    both = spaces.Tuple([spaces.Discrete(2), spaces.Discrete(3)])
    assert of_learners(both, (np.array([0, 1]), np.array([2, 0])))[1].tolist() == [[0, 2], [1, 0]]
    texts = spaces.Dict(image=PLACE, mission=spaces.Text(9))
    assert of_learners(texts, {"image": np.zeros((1, 2)), "mission": None})[1].shape == (1, 2)
    assert of_learners(spaces.Text(9), None) == (None, None)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "{}",
        '{"Box": 3}',
        '{"Box": [0, 1, [1000000, 1000000, 1000000], "<f4"]}',
        '{"Box": [0, 1, [2], "nothing"]}',
        '{"Box": [0, 1, [2], "O"]}',
        '{"Discrete": [0, "<i8"]}',
        '{"Discrete": [3, "<f8"]}',
        '{"MultiDiscrete": ["a", "<i8"]}',
        '{"MultiBinary": []}',
        '{"Dict": [["a", "{}"]]}',
        '{"Dict": {"a": 1}}',
        '{"__import__": ["os"]}',
        "[" * 100_000,
    ],
)
def test_a_strangers_space_is_read_or_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"^world\.npz: "):
        space_of_text(text, "world.npz")


def test_rows_that_do_not_fit_are_refused() -> None:
    assert misfit(spaces.Discrete(3), np.array([0, 2]), 2) is None
    assert "does not fit" in str(misfit(spaces.Discrete(3), np.array([0, 3]), 2))
    assert "does not fit" in str(misfit(spaces.MultiDiscrete([2, 2]), np.array([[0, 2]]), 1))
    assert "2 states" in str(misfit(PLACE, np.zeros((3, 2), np.int64), 2))
    assert "must have a, b, c" in str(misfit(SPACES["dict"], {"a": np.zeros(2)}, 2))
