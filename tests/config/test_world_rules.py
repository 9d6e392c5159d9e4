"""Settings that follow the world: what the agents' yaml files compute of it."""

from pathlib import Path

import pytest
from helpers.support import configure, script, train_in

import gridworld
from gridworld.config.agents import REPLAY_COUNTS, AgentConfig

DEFAULT = {
    "dqn": {"gamma": 0.9, "learning_rate": 0.001, "batch_size": 128, "buffer_size": 50_000}
    | {
        "gradient_steps": 32,
        "target_update_interval": 512,
        "exploration_final_eps": 0.05,
        "reward_scale": None,
    },
    "ppo": {"gamma": 0.95, "learning_rate": 0.01, "batch_size": 2048, "ent_coef": 0.5, "gae_lambda": 0.95},
}
LENGTHS = {"dqn": (30_000, 2_000), "ppo": (180_000, 10_000)}
AGENTS = pytest.mark.parametrize("agent", DEFAULT)


def widths(agent: AgentConfig) -> object:
    return vars(agent)["policy_kwargs"].net_arch


def extractor(agent: AgentConfig) -> object:
    settings = vars(agent) | vars(agent).get("arguments", {})
    kwargs = settings["policy_kwargs"]
    return (kwargs if isinstance(kwargs, dict) else vars(kwargs))["features_extractor_class"]


@AGENTS
def test_the_default_world_has_the_settings_that_it_was_tuned_with(agent: str) -> None:
    config = configure(f"agent={agent}")
    assert {name: vars(config.agent)[name] for name in DEFAULT[agent]} == DEFAULT[agent]
    assert (config.total_timesteps, config.evaluation.every) == LENGTHS[agent]
    assert (config.n_envs, config.exploring_starts, widths(config.agent)) == (128, 0.0, None)


@pytest.mark.parametrize("envs", [1024, 128, 1])
def test_with_chances_a_minibatch_is_the_rollout_of_any_number_of_environments(envs: int) -> None:
    config = configure("agent=ppo", "env.slip=0.1", f"n_envs={envs}", "agent.n_steps=5")
    agent = vars(config.agent)
    assert (agent["batch_size"], agent["n_epochs"]) == (5 * envs, 40)


@pytest.mark.parametrize(
    ("words", "batch", "epochs"),
    [
        (["agent.engine=stock"], 1024, 5),
        (["callbacks=[{_target_: mine.Own}]"], 1024, 5),
        (["agent.batch_size=64"], 64, 5),
        (["agent.n_epochs=3"], 4096, 3),
        (["env.slip=0", "agent.batch_size=4096"], 4096, 5),
    ],
)
def test_epochs_are_many_where_they_cost_little(words: list[str], batch: int, epochs: int) -> None:
    agent = vars(configure("agent=ppo", "env.slip=0.1", "n_envs=128", *words).agent)
    assert (agent["batch_size"], agent["n_epochs"]) == (batch, epochs)


@AGENTS
def test_they_follow_the_world_and_the_observation(agent: str) -> None:
    plain, random = configure(f"agent={agent}"), configure(f"agent={agent}", "env.slip=0.1")
    assert random.total_timesteps > plain.total_timesteps
    assert random.n_envs > plain.n_envs
    assert random.exploring_starts == 1
    assert (plain.stratified_draws, random.stratified_draws) == (False, True)
    assert vars(random.agent)["gamma"] == 0.95
    assert vars(configure(f"agent={agent}", "env.slip=0.2").agent)["gamma"] == 0.98
    large = configure(f"agent={agent}", "env.num_rows=12", "env.num_cols=12")
    assert large.total_timesteps == plain.total_timesteps * 144 // 30
    assert large.exploring_starts == (0.2 if agent == "ppo" else 0)
    assert (
        configure(f"agent={agent}", "env.num_rows=4", "env.num_cols=4").total_timesteps == LENGTHS[agent][0]
    )


@pytest.mark.parametrize(
    ("words", "counts", "batch"),
    [
        ([], False, 128),
        (["env.slip=0.1"], True, 1_048_576),
        (["env.slip=0.1", "exploration_bonus=0.1"], False, 4096),
        (["env.slip=0.1", "agent.n_steps=3"], False, 4096),
        (["env.slip=0.1", "agent.engine=stock"], False, 4096),
        (["env.slip=0.1", "callbacks=[{_target_: mine.Own}]"], False, 4096),
        (["env.slip=0.1", "callbacks=[{_target_: stable_baselines3.common.callbacks.X}]"], True, 1_048_576),
        (["env.slip=0.1", "agent.buffer_size=5000"], True, 1_048_576),
        (["env.slip=0.1", "agent.replay_buffer_class=mine.ReplayCounts"], False, 4096),
        (["env.slip=0.1", "agent.replay_buffer_class=null"], False, 4096),
    ],
)
def test_transitions_are_counted_where_actions_have_chances(
    words: list[str], counts: bool, batch: int
) -> None:
    agent = vars(configure("agent=dqn", *words).agent)
    assert (agent["replay_buffer_class"] == REPLAY_COUNTS) == counts
    assert agent["batch_size"] == batch


@AGENTS
def test_the_evaluations_discount_bounds_the_agents(agent: str) -> None:
    assert vars(configure(f"agent={agent}", "evaluation.gamma=0.5").agent)["gamma"] == 0.5


@pytest.mark.parametrize("agent", ["dqn", "ppo", "a2c", "trpo", "qrdqn"])
def test_what_is_seen_changes_the_features_alone(agent: str) -> None:
    plain, coordinates, image = (
        configure(f"agent={agent}", f"observation={kind}") for kind in ("one_hot", "coordinates", "image")
    )
    assert [extractor(each.agent) for each in (plain, coordinates, image)] == [
        None,
        "gridworld.agents.sb3.features.FourierFeatures",
        "gridworld.agents.sb3.features.ImageCells",
    ]
    names = {"agent", "observation"}
    settings = [
        {k: v for k, v in vars(each).items() if k not in names} for each in (plain, coordinates, image)
    ]
    assert settings[0] == settings[1] == settings[2]
    convolutions = configure(f"agent={agent}", "observation=image", "agent.policy=CnnPolicy")
    assert extractor(convolutions.agent) is None


def test_the_command_line_goes_before_them() -> None:
    config = configure("agent=dqn", "env.slip=0.1", "agent.gamma=0.5", "n_envs=7", "exploring_starts=0.25")
    assert (vars(config.agent)["gamma"], config.n_envs, config.exploring_starts) == (0.5, 7, 0.25)
    assert vars(config.agent)["reward_scale"] == 0.72  # by the discount that was given
    assert vars(configure("agent=dqn", "env.slip=0.1").agent)["reward_scale"] == 0.54


@AGENTS
@pytest.mark.parametrize(
    "word",
    [
        *("env=taxi_v4", "env=river_swim", "env.layout=nothing", "env.slip=3", "env.num_rows=1"),
        *("evaluation.gamma=2", "env.step_reward=0.1 evaluation.gamma=1"),
    ],
)
def test_unknown_worlds_have_the_default_worlds_settings(agent: str, word: str) -> None:
    """What is wrong with the others is told before training, in the sentence that it always had."""
    config = configure(f"agent={agent}", *word.split())
    assert config.n_envs == 128
    assert vars(config.agent)["gamma"] == DEFAULT[agent]["gamma"]


def test_a_map_that_changes_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "map.txt"
    file.write_text("S....G\n")
    small = gridworld.compose("agent=dqn", {"env.layout": str(file)})
    file.write_text("S....G\n" + 9 * "......\n")
    large = gridworld.compose("agent=dqn", {"env.layout": str(file)})
    assert large.total_timesteps == 2 * small.total_timesteps


def test_the_command_line_shows_rules_and_values(tmp_path: Path) -> None:
    rules = script("train.py", "--cfg", "job", "env.slip=0.2", cwd=tmp_path).stdout
    values = script("train.py", "--cfg", "job", "--resolve", "env.slip=0.2", cwd=tmp_path).stdout
    assert "gamma: ${clearest_gamma:${env}" in rules
    assert "gamma: 0.98" in values
    assert "n_envs: 16000" in values


def test_a_small_world_with_chances_is_certified(tmp_path: Path) -> None:
    quiet = [f"recording.{name}=false" for name in ("frames", "gif", "learning")]
    world = ["env.num_rows=4", "env.num_cols=4", "env.slip=0.1", "env.step_reward=-0.1"]
    summary = train_in(tmp_path, "agent=ppo", *world, "total_timesteps=400000", *quiet)
    assert summary["certified"]
