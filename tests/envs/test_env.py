"""The environment keeps Gymnasium's contract on every map, and the walk follows the rules."""

import pickle
import random
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import gridworld
from gridworld import GridWorldEnv, GridWorldVectorEnv, InputError, compile_mdp
from gridworld.world.layout import load, parse


@pytest.mark.parametrize("layout", gridworld.shipped_layouts())
def test_the_raw_env_passes_gymnasiums_checks(layout):
    env = gym.make("GridWorld-v0", layout=layout, slip=0.2).unwrapped
    check_env(env, skip_render_check=layout != "classic")


@pytest.mark.parametrize(
    ("imports", "env_id"),
    [
        ("import gymnasium as gym", "gridworld:GridWorld-v0"),
        ("import gymnasium as gym, gridworld", "GridWorld-v0"),
        ("from gridworld import OneHotObservation; import gymnasium as gym", "GridWorld-v0"),
    ],
    ids=["without an import of ours", "imported after Gymnasium", "through a name"],
)
def test_gymnasium_knows_the_id(imports, env_id):
    code = (
        f"{imports};"
        f"env = gym.make('{env_id}', layout='cliff', slip=0.1);"
        f"envs = gym.make_vec('{env_id}', num_envs=3, layout='cliff', slip=0.1);"
        "print(env.reset()[0], type(env.unwrapped).__name__, env.unwrapped.mdp.slip);"
        "print(*envs.reset()[0], type(envs.unwrapped).__name__, envs.unwrapped.mdp.slip);"
        "import sys; print(*[finder for finder in sys.meta_path if 'gridworld' in str(finder)]);"
        "import gridworld; spec = gym.spec(gridworld.ENV_ID); gridworld.register_envs();"
        "assert gym.spec(gridworld.ENV_ID) is spec"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == ["36 GridWorldEnv 0.1", "36 36 36 GridWorldVectorEnv 0.1", ""]


def walk(env, seed, steps=300):
    moves = np.random.default_rng(0).integers(4, size=steps)
    trace = [env.reset(seed=seed)]
    for move in moves:
        trace.append(env.step(move))
        if trace[-1][2]:
            trace.append(env.reset())
    return trace


def test_the_seed_alone_fixes_the_walk():
    env = GridWorldEnv(layout=parse("S..S\n.TG.\nS...", "map"), slip=0.3)
    before = random.getstate(), pickle.dumps(np.random.get_state())
    first = walk(env, 1)
    assert (random.getstate(), pickle.dumps(np.random.get_state())) == before
    np.random.random(3)
    assert walk(env, 1) == first == walk(GridWorldEnv(layout=env.mdp.layout, slip=0.3), 1)
    assert walk(env, 2) != first


@pytest.mark.parametrize("share", [1e-8, 0.3, 1.0])
def test_the_env_the_batch_and_the_evaluation_start_alike(share):
    """Where starts differ in probability: the same walk, and each start as often as is scored."""
    mdp = compile_mdp(parse("S..S\n.TG.\nS...", "map"), slip=0.3).with_exploring_starts(share)
    env, batch = GridWorldEnv(mdp=mdp), GridWorldVectorEnv(1, mdp=mdp, max_episode_steps=None)
    env.reset(seed=5), batch.reset(seed=5)
    counts = np.zeros(mdp.num_states)
    for _ in range(4000):
        state = env.reset()[0]
        assert batch.reset()[0].tolist() == [state]
        counts[state] += 1
    assert (counts[mdp.start == 0] == 0).all()
    drawn = mdp.start > 0
    spread = np.sqrt(4000 * mdp.start * (1 - mdp.start))
    assert (np.abs(counts - 4000 * mdp.start)[drawn] <= 5 * spread[drawn] + 1).all()


@pytest.mark.parametrize("share", [-1, 2, float("nan"), "x"])
def test_a_share_of_exploring_starts_is_a_probability(share):
    with pytest.raises(InputError, match=f"^share={share}: must be .*from 0 to 1$"):
        GridWorldEnv().mdp.with_exploring_starts(share)


@pytest.mark.parametrize("make", [GridWorldEnv, GridWorldVectorEnv])
def test_an_env_takes_a_compiled_world_alone(make):
    mdp = compile_mdp(load("four_rooms"), slip=0.3, step_reward=-0.1)
    env, same = make(mdp=mdp), make(layout="four_rooms", slip=0.3, step_reward=-0.1)
    assert env.mdp is mdp  # not compiled again
    env.reset(seed=5)
    same.reset(seed=5)
    action = 1 if make is GridWorldEnv else np.array([1])
    for _ in range(50):
        assert repr(env.step(action)) == repr(same.step(action))
    for other in ({"slip": 0.3}, {"layout": "maze"}, {"num_rows": 9}, {"trap_reward": 0}):
        with pytest.raises(InputError, match="mdp=four_rooms: has its own layout, slip and rewards"):
            make(mdp=mdp, **other)
    with pytest.raises(InputError, match="mdp=classic: must be a compiled world"):
        make(mdp="classic")


REFUSED = [  # (class, a setting, values that it cannot have)
    (GridWorldEnv, "delay", [-1, float("nan"), float("inf"), "0.1", None, True]),
    (GridWorldEnv, "cell_size", [0, -1, 2.5, "10", True]),
    (GridWorldEnv, "render_mode", ["rgb", "", "Human", 1]),
    (GridWorldVectorEnv, "num_envs", [0, 2.0]),
    (GridWorldVectorEnv, "max_episode_steps", [0, 1.5]),
    (GridWorldVectorEnv, "autoreset_mode", ["Never"]),
    (GridWorldVectorEnv, "render_mode", ["human"]),
    (GridWorldVectorEnv, "slip", [2]),
    (GridWorldVectorEnv, "num_rows", [-1]),
    (GridWorldVectorEnv, "stratified", ["false", None, 2]),
]


@pytest.mark.parametrize(("make", "name", "values"), REFUSED)
def test_settings_that_make_no_environment_are_refused(make, name, values):
    for value in values:
        with pytest.raises(InputError, match=name):
            make(**{name: value})
