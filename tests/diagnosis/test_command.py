"""The command `diagnose` on finished runs, and the picture that it draws."""

import itertools
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import hostile
from helpers.oracle import MOVES, World, maps
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import gridworld
from gridworld.base.errors import InputError
from gridworld.commands import diagnose
from gridworld.diagnosis.causes import learning
from gridworld.diagnosis.evidence import split_regret
from gridworld.diagnosis.verdict import draw_diagnosis
from gridworld.training.saved_run import SavedRun
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import parse

_SPOILT = ["agent=q_learning", "agent.learning_rate=0.001", "total_timesteps=2000", "seed=0"]


@pytest.fixture(scope="module")
def spoilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "spoilt"
    gridworld.train(*_SPOILT, folder=folder, progress=False)
    return folder


def test_it_ends_with_a_sentence_and_commands_that_can_be_typed(spoilt: Path, capsys) -> None:
    diagnose.main([str(spoilt)])
    told = capsys.readouterr().out
    assert re.search(r"^(The|\d+% of the) regret of 0.932: .*?\.$", told, re.MULTILINE | re.DOTALL)
    lines = [line.strip() for line in told.splitlines() if "gridworld train" in line]
    assert 1 <= len(lines) <= 3
    for line in lines:
        gridworld.compose(*shlex.split(line)[2:])  # every one is a valid setting
    run = gridworld.open_run(spoilt)
    found = gridworld.diagnose(run)
    assert found.sentence() == gridworld.diagnose(spoilt).sentence()
    assert found.split.cost.sum() == pytest.approx(run.summary["regret"], abs=1e-9)


@pytest.mark.parametrize(("columns", "most"), [(20, 80), (90, 90), (300, 100)])
def test_the_sentence_is_wrapped(spoilt: Path, columns: int, most: int, monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    diagnose.main([str(spoilt)])
    lines = capsys.readouterr().out.splitlines()
    first = next(number for number, line in enumerate(lines) if "regret of 0.932: " in line)
    sentence = lines[first : lines.index("Try, one at a time:")]
    assert len(sentence) > 1
    assert max(map(len, sentence)) <= most < len(" ".join(sentence))
    assert " ".join(sentence) == gridworld.diagnose(spoilt).sentence()


ENVS = """
import gymnasium as gym, numpy as np
class Image(gym.Env):
    observation_space, action_space = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8), gym.spaces.Discrete(2)
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = 3
        return self.shown(), {}
    def shown(self):
        image = np.full((8, 8, 3), 7, np.uint8)
        image[2, self.at] = 255
        return image
    def step(self, action):
        self.at = max(0, self.at + 2 * action - 1)
        return self.shown(), float(self.at == 7), self.at == 7, False, {}
class Vector(Image):
    observation_space = gym.spaces.Box(0, 1, (30,), np.float32)
    def shown(self):
        return np.eye(30, dtype=np.float32)[3 * self.at]
class Parts(Image):
    observation_space = gym.spaces.Dict(place=Vector.observation_space, lit=gym.spaces.Discrete(2))
    def shown(self):
        return {"place": Vector.shown(self), "lit": 1}
class Few(Image):
    observation_space = gym.spaces.Dict(at=gym.spaces.MultiDiscrete([8, 2]), lit=gym.spaces.Discrete(2))
    def shown(self):
        return {"at": np.array([self.at, 0]), "lit": np.int64(1)}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "name"),
    [
        ("Image", "observation with [2, 3, 0]=255, [2, 3, 1]=255, [2, 3, 2]=255"),
        ("Vector", "observation with [9]=1"),
        ("Parts", "observation with place[9]=1"),
        ("Few", "observation {'at': [3, 0], 'lit': 1}"),
    ],
)
def test_an_enumerated_state_is_named_by_what_it_shows(
    env: str, name: str, tmp_path: Path, monkeypatch, capsys
) -> None:
    (tmp_path / f"long_{env}.py").write_text(ENVS)
    monkeypatch.syspath_prepend(tmp_path)
    words = [
        "agent=q_learning",
        "tuned=none",
        "observation=none",
        "agent.initial_value=-1",
        "total_timesteps=64",
    ]
    run = gridworld.train(f"env=long_{env}:{env}", *words, folder=tmp_path / "run", seed=0, progress=False)
    mdp = run.evaluator.mdp
    assert mdp.state_name(int(mdp.start_states[0])) == name
    diagnose.main([str(tmp_path / "run"), "--trust"])
    told = capsys.readouterr().out
    assert name.partition("{" if "{" in name else "with ")[0] in told
    assert not re.search(r"\bstate \d", told)
    table = told[: told.index("Try, one at a time")].splitlines()[1:]
    assert max(map(len, table)) <= 80


def test_an_offer_has_the_steps_that_it_trains_and_about_its_time(tmp_path: Path, capsys) -> None:
    """Of PPO, which trains by whole rollouts, at first two of 32 steps in each of 16 environments."""
    words = ["agent=ppo", "n_envs=16", "agent.n_steps=32", "agent.batch_size=64", "total_timesteps=600"]
    gridworld.train(*words, "agent.max_grad_norm=1e-6", folder=tmp_path / "run", seed=0, progress=False)
    diagnose.main([str(tmp_path / "run")])
    lines = capsys.readouterr().out.splitlines()
    printed = [(line, under) for line, under in itertools.pairwise(lines) if "gridworld train" in line]
    assert printed
    for line, under in printed:
        config = gridworld.compose(*shlex.split(line)[2:])
        rollout = config.n_envs * config.agent.n_steps
        steps = -(-config.total_timesteps // rollout) * rollout
        assert re.fullmatch(rf"    {steps:,} steps, about \d+ (s|min \d+ s|h \d+ min)", under)
    trained = gridworld.train(*shlex.split(printed[0][0])[2:], progress=False)
    assert trained.summary["timesteps"] == 1024


@pytest.mark.slow
def test_many_large_updates_are_not_called_too_few(tmp_path: Path) -> None:
    words = ["agent=ppo", "n_envs=16", "agent.n_steps=32", "agent.batch_size=64", "total_timesteps=10000"]
    gridworld.train(*words, "agent.learning_rate=0.03", folder=tmp_path / "run", seed=0, progress=False)
    found = gridworld.diagnose(tmp_path / "run")
    assert found.cause == "rate"
    assert "after 800 at a learning rate of 0.03, its policy is hardly decided" in found.findings[0].why
    assert found.findings[0].changes[0] == "agent.learning_rate=0.003"


def test_a_target_that_follows_slowly_is_old_too(tmp_path: Path) -> None:
    words = ["agent=dqn", "agent.tau=0.002", "agent.target_update_interval=10000"]
    gridworld.train(*words, folder=tmp_path / "run", seed=0, progress=False)
    found = gridworld.diagnose(tmp_path / "run")
    assert found.cause == "target"
    assert "was refreshed 3 times by 0.2%, but a value needs 8 whole refreshes" in found.findings[0].why
    assert found.findings[0].changes[0] == "agent.target_update_interval=469 agent.tau=1"


def test_the_picture_has_the_world_and_the_cells_that_cost(spoilt: Path) -> None:
    diagnose.main([str(spoilt)])
    with Image.open(spoilt / "diagnosis.png") as picture:
        assert min(picture.size) > 200
    found = gridworld.diagnose(spoilt)
    row, col = divmod(int(np.argmax(found.split.cost)), 6)
    cell = draw_diagnosis(found, 40)[(row + 1) * 40 + 4, (col + 1) * 40 + 36]
    assert cell.tolist() == [127, 0, 0, 255]  # the end of the scale


def test_a_world_without_places_is_diagnosed_and_drawn_too() -> None:
    pessimistic = ["agent.initial_value=-1", "total_timesteps=500"]
    run = gridworld.train("agent=q_learning", "env=combination_lock", *pessimistic, seed=0, progress=False)
    found = gridworld.diagnose(run)
    assert found.findings
    assert draw_diagnosis(found).ndim == 3


@pytest.mark.slow
def test_offers_are_tried_until_one_is_certified(tmp_path: Path, capsys) -> None:
    slow = ["agent=q_learning", "agent.learning_rate=0.001", "total_timesteps=20000"]
    gridworld.train(*slow, folder=tmp_path / "slow", seed=3, progress=False)
    diagnose.main([str(tmp_path / "slow"), "--try"])
    told = capsys.readouterr().out
    tried = sorted((tmp_path / "slow-tried").iterdir())
    assert f"certified optimal: {tried[-1]}" in told
    last = gridworld.open_run(tried[-1])
    assert last.summary["certified"]
    typed = told[: told.index(f"    certified optimal: {tried[-1]}")].splitlines()[-1]
    again = gridworld.train(*shlex.split(typed)[2:], progress=False)
    assert again.summary["regret"] == last.summary["regret"]
    assert again.curve["regret"].tolist() == last.curve["regret"].tolist()


def test_where_no_offer_is_certified_the_exit_code_is_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setattr(learning, "_settling", lambda run: ("agent.learning_rate=0.9", "agent.gamma=7"))
    wild = ["agent=q_learning", "agent.learning_rate=1", "env.slip=0.3", "total_timesteps=600"]
    run = gridworld.train(*wild, "env.layout=aima_4x3", folder=tmp_path / "a run", seed=1, progress=False)
    found = gridworld.diagnose(run, try_offers=True)
    assert not found.tried[-1].certified
    assert [each.folder.name for each in found.tried] == [str(n + 1) for n in range(len(found.tried))]
    with pytest.raises(SystemExit) as ended:
        diagnose.main([str(tmp_path / "a run"), "--try"])
    assert ended.value.code == 1
    assert "None of them is certified." in capsys.readouterr().out


STRANGERS = [
    *("+evil=${oc.env:HOME}", "hydra.searchpath=[pkg://os]", "--config-dir=/tmp", "env/schema@env=built"),
    *("agent.algorithm=os.system", "callbacks=[{_target_: os.system, command: ls}]"),
]


def test_nothing_of_strangers_runs_in_a_trial(spoilt: Path, tmp_path: Path, capsys) -> None:
    folder = tmp_path / "strangers"
    shutil.copytree(spoilt, folder)
    hostile.manifest(folder, lambda content: content["overrides"].extend(STRANGERS))
    assert not set(STRANGERS) & set(SavedRun(folder).overrides)
    assert gridworld.diagnose(folder).offers == ()
    diagnose.main([str(folder)])
    told = capsys.readouterr().out
    assert "its command line may run code, read other files or contact servers" in told
    assert "Try" not in told
    with pytest.raises(InputError, match="may run code"):
        diagnose.main([str(folder), "--try"])


def test_of_a_certified_run_nothing_is_named_or_drawn(tmp_path: Path, capsys) -> None:
    gridworld.train("agent=value_iteration", folder=tmp_path / "best", progress=False)
    diagnose.main([str(tmp_path / "best"), "--try"])
    told = capsys.readouterr().out.splitlines()
    assert told[1:] == ["Certified optimal: there is no regret to explain."]
    assert not (tmp_path / "best" / "diagnosis.png").exists()


# ---- the regret's shares of the states: against a second computation by loops, and what they add up to -----


_SETTINGS = st.fixed_dictionaries(
    {
        "slip": st.sampled_from([0.0, 0.1, 0.5]),
        "step_reward": st.sampled_from([0.0, -0.1, -1.0]),
        "trap_reward": st.sampled_from([-1.0, 0.0]),
    }
)


def _policy(num_states: int, seed: int, greedy: bool) -> np.ndarray:
    random = np.random.default_rng(seed)
    if greedy:
        return one_hot_policy(random.integers(4, size=num_states), 4)
    return random.dirichlet(np.ones(4), size=num_states)


@given(maps(), _SETTINGS, st.integers(0, 99), st.booleans(), st.sampled_from([0.0, 0.5, 0.9]))
def test_every_share_is_that_of_the_oracle(rows, settings, seed, greedy, gamma) -> None:
    world = World(rows, **settings)
    evaluator = Evaluator(compile_mdp(parse("\n".join(rows), "map"), **settings), gamma, 50)
    policy = _policy(evaluator.mdp.num_states, seed, greedy)
    split = split_regret(evaluator, policy)
    best = world.optimal_values(gamma)
    chance, weight = {cell: (cell in world.starts) / len(world.starts) for cell in world.cells}, 1.0
    cost = dict.fromkeys(world.cells, 0.0)
    while weight > 1e-13:  # step by step, discounted
        following = dict.fromkeys(world.cells, 0.0)
        for cell in world.cells:
            for action in MOVES if chance[cell] else ():
                share = chance[cell] * policy[world.state(cell)][action]
                cost[cell] += weight * share * (best[cell] - world.q(best, cell, action, gamma))
                for probability, target, _, _ in world.outcomes(cell, action):
                    following[target] += share * probability
        chance, weight = following, weight * gamma
    for cell in world.cells:
        assert split.cost[world.state(cell)] == pytest.approx(cost[cell], abs=1e-9)


@given(maps(), _SETTINGS, st.integers(0, 99), st.booleans(), st.sampled_from([0.5, 0.99, 0.9999, 1.0]))
def test_the_shares_add_up_to_the_regret(rows, settings, seed, greedy, gamma) -> None:
    evaluator = Evaluator(compile_mdp(parse("\n".join(rows), "map"), **settings), gamma, 50)
    policy = _policy(evaluator.mdp.num_states, seed, greedy)
    split = split_regret(evaluator, policy)
    regret, scale = evaluator.score(policy).regret, max(1.0, float(evaluator.solution.scale.max()))
    if np.isfinite(regret):
        assert split.cost.sum() == pytest.approx(regret, abs=1e-9 * scale)
        assert (split.cost >= -1e-9 * scale).all()
    else:
        assert split.cost.sum() == regret
    if gamma < 1:  # else it may cost something to go in circles by optimal actions
        assert np.abs(split.cost[~split.wrong]).max() <= 1e-7 * scale


def test_without_a_discount_an_endless_walk_costs_where_it_stops() -> None:
    evaluator = Evaluator(compile_mdp(parse("S.G", "map")), 1.0, 50)
    left = one_hot_policy(np.full(3, 3), 4)
    assert split_regret(evaluator, left).cost.tolist() == [1.0, 0.0, 0.0]
