"""A mistake on a command line gets one sentence, exit code 2, no traceback, and leaves nothing behind."""

import json
import os
import warnings
from pathlib import Path

import pytest
from helpers.support import SHORT, configure, script, train_in

from gridworld.errors import InputError
from gridworld.storage.sealed_json import sealed
from gridworld.training.train import train

YAMLS: dict[str, bytes] = {
    "agent/broken.yaml": b"a: [1\nb: 2\n",
    "agent/empty.yaml": b"",
    "agent/binary.yaml": b"\xff\xfe",
    "agent/endless.yaml": b"a: &a [*a]\n",
    "agent/mine.yaml": b"# @package _global_\ndefaults:\n  - /agent/schema/sb3@agent\n  - _self_\n"
    b"agent: {name: mine, algorithm: own_module.Mine}\n",
    "env/tagged.yaml": b"layout: !!python/object/apply:os.system [ls]\n",
    "env/misspelt.yaml": b"layuot: cliff\n",
    "own_module.py": b"1 / 0\n",
    "needy.py": b"import not_installed\n",
}

MAPS = {
    "unknown": "S.x\n..G\n",
    "ragged": "S..\n.G\n",
    "no_start": "...\n..G\n",
    "no_goal": "S..\n...\n",
    "empty": "",
    "enclosed": "S#G\n.#.\n",
}

# (command line, words of the sentence)
TRAIN = [
    ("env.layout={maps}/unknown.txt", "unknown.txt: row 1, column 3: unknown tile 'x'"),
    ("env.layout={maps}/ragged.txt", "ragged.txt: row 2 has 2 columns, row 1 has 3"),
    ("env.layout={maps}/no_start.txt", "no_start.txt: there is no start"),
    ("env.layout={maps}/no_goal.txt", "no_goal.txt: there is no goal"),
    ("env.layout={maps}/empty.txt", "empty.txt: the map is empty"),
    ("env.layout={maps}/enclosed.txt", "no goal can be reached from the start in row 1, column 1"),
    ("env.layout={maps}/binary.txt", "not a text file"),
    ("env.layout={maps}/large.txt", "at most 262144 cells"),
    ("env.layout={maps}", "cannot be read"),
    ("env.layout=nowhere.txt", "neither a shipped layout (aima_4x3, classic"),
    ("env.num_rows=3 env.num_cols=9", "layout classic of 3 x 9 cells: no goal can be reached from the start"),
    ("env.num_cols=2", "classic of 5 x 2 cells: row 3, column 0: this trap lies outside the grid; give at"),
    ("env.num_rows=0", "num_rows=0: must be a whole number of at least 1"),
    ("env.num_cols=-2", "num_cols=-2: must be a whole number of at least 1"),
    ("env.num_rows=4.5", "env.num_rows=4.5: Value '4.5' of type 'float' could not be converted to Integer"),
    ("env.num_rows=true", "env.num_rows=true: Value 'True' of type 'bool'"),
    ("env=maze env.num_rows=9", "num_rows=9: the map maze has 15"),
    ("env.slip=1.5", "slip=1.5: must be a probability, from 0 to 1"),
    ("env.slip=nan", "slip=nan: must be a finite number"),
    ("env.goal_reward=inf", "goal_reward=inf: must be a finite number"),
    ("env.max_episode_steps=0", "env.max_episode_steps=0: must be at least 1"),
    ("agent.learning_rate=-1", "agent.learning_rate=-1: must be a number of at least 0"),
    ("agent.learning_rate=nan", "agent.learning_rate=nan: must be"),
    ("agent.learning_rate=inf", "agent.learning_rate=inf: must be"),
    ("agent.learning_rate=fast", "agent.learning_rate=fast: must be a number of at least 0, or lin_NUMBER"),
    ("agent.learning_rate=true", "agent.learning_rate=true"),
    ("agent=ppo agent.clip_range=quad_1", "clip_range=quad_1: must be a number of at least 0, or lin_NUMBER"),
    ("agent.gamma=1.1", "agent.gamma=1.1: must be from 0 to 1"),
    ("evaluation.gamma=-0.1", "evaluation.gamma=-0.1: must be from 0 to 1"),
    ("evaluation.gamma=1 env.step_reward=1", "return may grow without end"),
    ("evaluation.every=0", "evaluation.every=0: must be at least 1"),
    ("total_timesteps=0", "total_timesteps=0: must be at least 1"),
    ("total_timesteps=1.5e0", "total_timesteps=1.5e0: Value '1.5'"),
    ("seed=-1", "seed=-1: must be at least 0"),
    ("seed=abc", "seed=abc: Value 'abc' of type 'str' could not be converted to Integer"),
    ("seed=1,2", "Ambiguous value for argument 'seed=1,2'; to run one job for each of the values, add -m"),
    ("seed=[1", "seed=[1: no viable alternative"),
    ("n_envs=0", "n_envs=0: must be at least 1"),
    ("threads=0", "threads=0: must be at least 1"),
    ("exploration_bonus=-0.1", "exploration_bonus=-0.1: must be from 0 to 1000000"),
    ("agent=ppo agent.batch_size=1000", "agent.batch_size=1000: must divide the rollout"),
    ("agent=ppo agent.use_sde=true", "agent.use_sde=true: gSDE explores continuous actions"),
    ("agent=ppo agent.clip_range=-0.1", "agent.clip_range=-0.1: must be"),
    ("agent=ppo agent.ent_coef=nan", "agent.ent_coef=nan: must be a number of at least 0, or lin_NUMBER"),
    ("agent=ppo agent.ent_coef=lin_0_3", "agent.ent_coef=lin_0_3: must be a number of at least 0, or lin_"),
    ("agent=ppo agent.ent_coef=cub_1", "linear decay (sqrt_, quad_: for one by a root or a square)"),
    ("agent=ppo agent.gae_lambda=lin_1.5", "agent.gae_lambda=lin_1.5: must be from 0 to 1"),
    (
        "agent=a2c +agent.arguments.gae_lambda=quad_2",
        "agent.arguments.gae_lambda=quad_2: must be from 0 to 1",
    ),
    ("agent=ppo agent.target_kl=0", "agent.target_kl=0.0: must be a positive number"),
    ("agent.buffer_size=10", "agent.buffer_size=10: smaller than a batch"),
    ("agent.learning_starts=100000", "must be below total_timesteps="),
    ("agent.train_freq=often", "agent.train_freq=often: must be a whole number"),
    ("agent.train_freq=[1,episode]", "SB3 counts episodes with one environment only; set n_envs=1"),
    ("agent.exploration_fraction=0", "agent.exploration_fraction=0.0: must be a positive number"),
    (
        "agent=dqn_sb3_defaults observation=image observation.features=null",
        "agent.policy=MlpPolicy cannot see images without observation.features; leave that out, or set",
    ),
    ("agent.policy=CnnPolicy", "agent.policy=CnnPolicy sees images only"),
    ("agent=sarsa_max", "agent=sarsa_max: there is no such choice; there are a2c, a2c_sb3_defaults"),
    ("experiment=cliff_qlearning", "there is no such choice; close to it are cliff_q_learning, "),
    ("experiment=maze", "close to it are maze_a2c, maze_a2c_sb3_defaults, maze_dqn, "),
    ("experiment=zz", "experiment=zz: there is no such choice; --help lists them all"),
    ("tuned=cliff_dq", "tuned=cliff_dq: there is no such recipe; close to it are cliff_dqn"),
    ("preset=slippery", "preset=slippery: there is no such choice; there are auto, large, none, stochastic"),
    ("env=mars", "env=mars: there is no such choice; there are aima_4x3, arrays"),
    ("env=null", "a choice is a name, and null is none: write preset=none, tuned=none, or ~experiment"),
    ("ganma=1", "Key 'ganma' not in 'TrainConfig'"),
    ("agent.learning_rat=1", "Key 'learning_rat' not in 'DQNConfig'; did you mean learning_rate"),
    ("+agent.learning_rat=1", "agent.learning_rat: there is no such key; did you mean learning_rate"),
    ("agent.policy_kwargs.netarch=[8]", "Key 'netarch' not in 'PolicyKwargs'; did you mean net_arch?"),
    ("agent.algorithm=PPO", "agent.algorithm=PPO: these are the settings of DQN"),
    ("agent.policy_kwargs.net_arch={{pi:[8],vf:[8]}}", "DQN has one network"),
    (
        "agent.policy_kwargs.optimizer_kwargs={{eps:1e-5}}",
        "a new entry of a dictionary needs a plus: +agent.policy_kwargs.optimizer_kwargs.eps=...",
    ),
    ("agent=trpo agent.arguments.use_sde=true", "a plus: +agent.arguments.use_sde=..."),
    ("agent.family=tf", "agent.family=tf: there is no such family"),
    ("agent.family=tabular", "agent.family=tabular: these are the settings of sb3; choose agent=..."),
    ("agent=sarsa agent.family=sb3", "agent.family=sb3: these are the settings of tabular"),
    ("agent=sarsa agent.algorithm=q_learning", "these are the settings of sarsa; choose agent=..."),
    ("agent=sarsa observation=image", "observation=image: agent=sarsa keeps a table over the states"),
    ("agent=sarsa device=cuda", "device=cuda: agent=sarsa runs on the processor; must be cpu"),
    ("agent=q_learning agent.learning_rate=2", "agent.learning_rate=2: a step towards the target must be"),
    ("agent=q_learning agent.learning_rate=lin_0", "agent.learning_rate=lin_0: a step towards the target"),
    ("agent=q_learning agent.learning_rate=fast", "must be a number of at least 0, or lin_NUMBER"),
    ("agent=q_learning agent.learning_rate_power=2", "agent.learning_rate_power=2.0: must be from 0 to 1"),
    ("agent=q_learning agent.initial_value=nan", "agent.initial_value=nan: must be a finite number"),
    ("agent=q_learning agent.gamma=-1", "agent.gamma=-1.0: must be from 0 to 1"),
    ("agent=q_learning agent.exploration_fraction=0", "agent.exploration_fraction=0.0: must be a positive"),
    ("agent=q_learning agent.exploration_final_eps=3", "agent.exploration_final_eps=3.0: must be from 0"),
    ("agent=q_learning agent.log_interval=0", "agent.log_interval=0: must be at least 1"),
    ("agent=q_learning agent.n_steps=3", "Key 'n_steps' not in 'QLearningConfig'"),
    ("agent=value_iteration agent.gamma=1 env.step_reward=1", "return may grow without end"),
    ("agent=value_iteration agent.learning_rate=1", "Key 'learning_rate' not in 'ValueIterationConfig'"),
    ("recording.cell_size=100000", "too large to draw"),
    ("recording.fps=0", "recording.fps=0: must be from 1 to 100"),
    ("--frobnicate", "unrecognized arguments: --frobnicate"),
    (
        "hydra.run.dir=../../x",
        "hydra.run.dir=../../x: leads out of the current folder; if that is meant, say /",
    ),
    ("hydra.run.dir=runs/../../x", "hydra.run.dir=runs/../../x: leads out of the current folder"),
    ("hydra.run.dir=.", "hydra.run.dir=.: is the current folder; name one in it, e.g. runs/mine"),
    ("hydra.output_subdir=../x", "hydra.output_subdir=../x: must be a plain name, without /"),
    ("hydra.output_subdir=..", "hydra.output_subdir=..: must be a plain name"),
    ("hydra.job.name=a/b", "hydra.job.name=a/b: must be a plain name, without /"),
    ("n_envs=1000000000000", "n_envs=1000000000000: must be at most 131072"),
    ("threads=100000", "threads=100000: must be at most 1024"),
    ("env.max_episode_steps=1000000", "env.max_episode_steps=1000000: must be at most 100000"),
    ("env=frozen_lake_4x4 env.num_rows=5", "num_rows=5: the map frozen_lake_4x4 has 4; leave num_rows out"),
    ("env.layout=frozen_lake_4x4 env.num_cols=6", "num_cols=6: the map frozen_lake_4x4 has 4"),
    ("--config-dir nowhere", "nowhere' not found"),
    (
        "--config-dir {conf} agent=broken",
        "agent/broken.yaml: line 2, column 2: is not valid YAML: expected ',' or ']'",
    ),
    (
        "--config-dir={conf} env=tagged",
        "env/tagged.yaml: line 1, column 9: is not valid YAML: could not determine a con",
    ),
    (
        "--config-dir {conf} agent=empty",
        "agent.name: has no value; give agent.name=...",
    ),
    ("--config-dir {conf} agent=binary", "agent/binary.yaml: byte 1 is no UTF-8"),
    ("--config-dir {conf} agent=endless", "agent/endless.yaml: is nested too deeply, or contains itself"),
    ("--config-dir {conf} env=misspelt", "In 'env/misspelt': ConfigKeyError raised while composing config"),
]

TRAIN_WITH_SB3 = [
    ("agent.policy=TransformerPolicy", "agent.policy=TransformerPolicy: DQN has MlpPolicy, CnnPolicy"),
    ("agent.policy_kwargs.net_arch=[0]", "agent.policy_kwargs.net_arch=[0]: must be layer widths"),
    (
        "agent.policy_kwargs.net_arch=[100000]",
        "must be layer widths, e.g. [64,64]; at most 16 of at most 4096",
    ),
    (
        "agent.n_steps=3 agent.replay_buffer_class=gridworld.agents.sb3.replay_counts.ReplayCounts",
        "ReplayCounts counts single steps; must be 1, or set agent.replay_buffer_class=null",
    ),
    ("agent.replay_buffer_class=torch.nn.ReLU", "must be the import path of a BaseBuffer class"),
    (
        "agent=a2c agent.algorithm=nowhere.Mine",
        "agent.algorithm=nowhere.Mine: there is no module nowhere; is the",
    ),
    (
        "agent=a2c agent.algorithm=stable_baselines3.no.Mine",
        "there is no module stable_baselines3.no; is the",
    ),
    ("--config-dir {conf} agent=mine", "own_module cannot be imported (ZeroDivisionError: division by zero)"),
    ("--config-dir {conf} agent=mine agent.algorithm=needy.Mine", "needy needs not_installed, which is not"),
    ("agent.policy_kwargs.activation_fn=os.system", "activation_fn=os.system: must be the import path"),
    ("device=cuda:99", "device=cuda:99: torch finds no CUDA device"),
    ("device=abacus", "device=abacus: must be auto, cpu, cuda or cuda:N"),
    ("observation=image agent.policy=CnnPolicy observation.cell_size=4", "32 x 28 pixels are too small"),
    (
        "observation=coordinates +agent.policy_kwargs.features_extractor_kwargs.orders=[4]",
        "FourierFeatures: orders=[4]: must be 2 whole numbers, one for each coordinate",
    ),
    (
        "observation=image +agent.policy_kwargs.features_extractor_kwargs.cell_size=abc",
        "PixelCNN: cell_size=abc: must be from 1 to the image's",
    ),
    (
        "observation=image observation.features=FourierFeatures",
        "observation.features=FourierFeatures: must be",
    ),
    (
        "observation=image observation.features=torch.nn.ReLU",
        "must be the import path of a BaseFeaturesExtractor",
    ),
    ("agent=a2c +agent.arguments.policy_kwargs=3", "agent.arguments.policy_kwargs=3: must be settings"),
    (
        "agent=a2c +agent.arguments.policy_kwargs.features_extractor_kwargs=3",
        "look at agent.arguments.policy_kwargs.features_extractor_kwargs=3",
    ),
]


# In a process each; the others are in forks of one, see `script`.
REAL = (
    *("env.layout={maps}/ragged.txt", "agent.learning_rat=1", "--frobnicate"),
    *("--config-dir {conf} agent=broken", "--config-dir {conf} agent=mine"),
)


# (settings, words of the sentence): of the right type, and beyond what any number here holds
ABSURD = [
    *(
        (f"agent={agent} env.{name}={value}", f"{name}={float(value)}: must be 0 or of a size from {bounds}")
        for agent, least, most, cut in (("q_learning", 1e-100, 1e100, 1), ("dqn", 1e-30, 1e15, 100))
        for name, times in (("step_reward", cut), ("goal_reward", 1), ("trap_reward", 1))
        for value in ("1e307", "-1e307", "1e-320")
        for bounds in [f"{least:g} to {most / times:g}"]
    ),
    (
        "agent=a2c env.goal_reward=1e20",
        "env.goal_reward=1e+20: must be 0 or of a size from 1e-30 to 1e+15, for",
    ),
    ("agent=q_learning agent.initial_value=1e307", "agent.initial_value=1e+307: must be 0 or of a size from"),
    (f"agent.learning_rate={10**400}", "must be a number of at least 0, or lin_NUMBER"),
    (f"agent.stats_window_size={10**30}", "must be from 1 to 1000000000"),
    (f"agent=sarsa agent.stats_window_size={10**30}", "must be from 1 to 1000000000"),
    (f"agent.n_steps={10**30}", "must be from 1 to 100000"),
    (f"agent.train_freq={10**30}", "must be at most 100000"),
    (f"agent=qrdqn +agent.arguments.train_freq={10**30}", "must be at most 100000"),
    ("agent=qrdqn +agent.arguments.tau=1e307", "agent.arguments.tau=1e+307: must be from 0 to 1"),
    ("agent=ppo agent.clip_range=1e307", "agent.clip_range=1e+307: must be at most 1000000000000000"),
    (
        "agent=ppo agent.clip_range_vf=lin_1e307",
        "agent.clip_range_vf=1e+307: must be at most 1000000000000000",
    ),
    (f"agent=ppo agent.stats_window_size={10**400}", "must be from 1 to 1000000000"),
]


@pytest.mark.parametrize(("line", "words"), ABSURD, ids=lambda value: str(value)[:60])
def test_an_absurd_number_is_refused_before_it_is_used(line: str, words: str, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError) as mistake:
            train(configure(*line.split()), tmp_path, [])
    assert words in str(mistake.value)
    assert list(tmp_path.iterdir()) == []


def test_the_largest_rewards_are_calculated_with_without_an_overflow(tmp_path: Path) -> None:
    """The smallest, too: they are no nothing."""
    quiet = ["recording.learning=false", "recording.frames=false", "recording.gif=false"]
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for agent, size in (("q_learning", 1e100), ("q_learning", 1e-100), ("ppo", 1e15), ("ppo", 1e-30)):
            rewards = [
                f"env.goal_reward={size}",
                f"env.trap_reward={-size}",
                f"env.step_reward={-size / 100 if size > 1 else 0}",
            ]
            summary = train_in(tmp_path / f"{agent} {size}", *SHORT[agent], *rewards, *quiet)
            assert summary["optimal_goal_probability"] == 1


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    for name, text in MAPS.items():
        (folder / f"{name}.txt").write_text(text)
    (folder / "binary.txt").write_bytes(bytes(range(128, 256)))
    (folder / "large.txt").write_text(("." * 1000 + "\n") * 300)
    return folder


@pytest.fixture(scope="module")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Yaml files and modules of a user's own, each with a mistake."""
    folder = tmp_path_factory.mktemp("conf")
    for name, content in YAMLS.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize(("line", "words"), TRAIN + TRAIN_WITH_SB3, ids=lambda value: str(value)[:60])
def test_train_refuses_before_it_writes(
    line: str, words: str, maps: Path, conf: Path, tmp_path: Path
) -> None:
    path = f"{conf}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    words_given = line.format(maps=maps, conf=conf).split()
    done = script("train.py", *words_given, cwd=tmp_path, real=line in REAL, PYTHONPATH=path)
    sentence = done.stderr.strip().splitlines()[-1]
    assert words in sentence
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_used_folder_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "used" / "checkpoints").mkdir(parents=True)
    (tmp_path / "used" / "checkpoints" / "000000001000.state").touch()
    manifest = sealed({"status": "finished", "config": {}, "layout": []})
    (tmp_path / "used" / "manifest.json").write_text(json.dumps(manifest))
    done = script("train.py", "hydra.run.dir=used", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "error: used: holds a run already; choose another folder, or make that run longer by "
        "python scripts/train.py resume=used total_timesteps=...\n"
    )
    assert {path.name for path in (tmp_path / "used").iterdir()} == {"manifest.json", "checkpoints"}


def test_a_folder_under_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = script("train.py", "hydra.run.dir=file/run", cwd=tmp_path)
    assert done.returncode == 2
    assert "error: file/run: cannot be made, file is a file" in done.stderr


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("seed=range(0)", "seed=range(0): there is nothing in it"),
        ("seed=range(10001)", "10,001 jobs; if so many are meant, add hydra.sweeper.max_jobs=10001"),
        ("seed=interval(0,1)", "jobs are made of a list, a,b,c, or of range(start, stop)"),
        ("seed=-1,-2", "seed=-1: must be at least 0 (2 of 2 jobs cannot run)"),
        ("seed=0,-1 hydra.sweeper.stop_at_first_failure=true", "(1 of 2 jobs cannot run)"),
        ("agent=dqn,sarsa_max", "agent=sarsa_max: there is no such choice; there are a2c, a2c_sb3_defaults"),
        ("total_timesteps=100,often", "total_timesteps=often: Value 'often' of type 'str'"),
        ("ganma=0,1", "Key 'ganma' not in 'TrainConfig'"),
        ("hydra.sweeper.retry_fail=true", "did you mean retry_failed?"),
        (
            "hydra/launcher=abacus",
            "hydra/launcher=abacus: there is no such choice; there are basic, forks, joblib, ray, slurm",
        ),
        ("hydra/launcher=joblib hydra.launcher.n_jobs=0", "hydra.launcher.n_jobs=0: must be the number"),
        ("hydra/launcher=slurm hydra.launcher.jobs_per_task=0", "jobs_per_task=0: must be at least 1"),
        ("hydra/launcher=slurm hydra.launcher.nodes=2", "Key 'nodes' not in 'SlurmConfig'"),
        ("hydra.sweep.dir=used", "used: is the folder of a single run; choose another hydra.sweep.dir"),
        ("hydra.sweep.dir=.", "hydra.sweep.dir=.: is the current folder; name one in it, e.g. runs/mine"),
        ("hydra.sweep.dir=./used/..", "is the current folder; name one in it"),
        ("hydra.sweep.dir=../x", "hydra.sweep.dir=../x: leads out of the current folder; if that is meant"),
        ("hydra.sweep.subdir=mine", "hydra.sweep.subdir=mine: a sweep names the folders of its jobs itself"),
        ("hydra.job.name=../x", "hydra.job.name=../x: must be a plain name, without /"),
        ("hydra.sweep.dir=used/manifest.json", "cannot be made, used/manifest.json is a file"),
        ("hydra.sweep.dir=/proc/sweep", "/proc/sweep: cannot be"),
    ],
)
def test_a_sweep_is_refused_before_it_writes(line: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "manifest.json").write_text("{}")
    done = script("train.py", "-m", *line.split(), cwd=tmp_path)
    assert words in done.stderr.strip().splitlines()[-1]
    assert (done.returncode, done.stdout) == (2, "")
    assert "Traceback" not in done.stderr
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["manifest.json"]


@pytest.mark.parametrize(
    ("launcher", "package", "extra"),
    [("slurm", "submitit", "slurm"), ("ray", "ray", "ray")],
)
def test_a_launcher_that_is_not_installed_names_its_extra(
    launcher: str, package: str, extra: str, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(f"import sys; sys.modules['{package}'] = None\n")
    path = f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    line = ["-m", "seed=0,1", f"hydra/launcher={launcher}"]
    done = script("train.py", *line, cwd=tmp_path, real=True, PYTHONPATH=path)
    assert done.returncode == 2
    assert done.stderr == (
        f"error: hydra/launcher={launcher}: {package} is not installed; "
        f"pip install 'gridworld-sb3[{extra}]'\n"
    )


def test_slurm_is_started_where_it_is(tmp_path: Path) -> None:
    done = script("train.py", "-m", "seed=0,1", "hydra/launcher=slurm", cwd=tmp_path, PATH=str(tmp_path))
    assert done.returncode == 2
    assert done.stderr.startswith("error: hydra/launcher=slurm: there is no sbatch on this machine; start")


def test_a_sweeps_folder_is_no_runs(tmp_path: Path) -> None:
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "sweep.json").write_text("{}")
    done = script("train.py", "hydra.run.dir=sweep", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: sweep: is the folder of a sweep; choose another hydra.run.dir\n"


def test_divergence_is_told_and_marked(tmp_path: Path) -> None:
    done = script("train.py", "agent.learning_rate=1e30", "hydra.run.dir=run", cwd=tmp_path)
    assert done.returncode == 2
    assert "training diverged" in done.stderr
    assert '"status": "failed"' in (tmp_path / "run" / "manifest.json").read_text()


@pytest.mark.parametrize(
    ("name", "line", "words"),
    [
        ("evaluate.py", "nowhere", "nowhere: no such folder"),
        ("evaluate.py", ".", "not a run's folder, it has no manifest.json"),
        ("evaluate.py", ". --episodes 0", "--episodes 0: must be from 1 to"),
        ("evaluate.py", ". --render human", "there is no display"),
        ("evaluate.py", "", "the following arguments are required: run"),
        ("record.py", "nowhere", "nowhere: no such folder"),
        ("record.py", ". --fps 0", "--fps 0: must be from 1 to 100"),
        ("record.py", ". --cell-size 1", "--cell-size 1: must be at least 2"),
        ("record.py", ". --format bmp", "invalid choice: 'bmp'"),
        ("record.py", ". --episodes 0", "--episodes 0: must be from 1"),
        ("play.py", "", "play.py: there is no display to open a window on; set DISPLAY"),
        ("play.py", "--layout mars", "neither a shipped layout"),
        ("play.py", "--slip 2", "slip=2.0: must be a probability"),
        ("play.py", "--gamma 1 --step-reward 1", "gamma=1 with step_reward=1.0"),
        ("play.py", "--gamma 1.5", "gamma=1.5: a discount must be a number from 0 to 1"),
        ("play.py", "--seed -1", "--seed -1: must be at least 0"),
        ("play.py", "--cell-size 3", "--cell-size 3: must be at least 8 pixels"),
        ("play.py", "--cell-size 10000", "too large to draw"),
        ("play.py", "--agent nowhere", "nowhere: no such folder"),
        ("play.py", "--agent nowhere --num-rows 9", "with --agent, the world has the size it was trained on"),
        ("reproduce.py", "nowhere", "nowhere: no such folder"),
        ("reproduce.py", ".", "not a run's folder, it has no manifest.json"),
        ("reproduce.py", "", "the following arguments are required: run"),
        ("reproduce.py", ". --keep", "argument --keep: expected one argument"),
        ("record.py", ". --out ../x", "--out=../x: leads out of the current folder; if that is meant, say /"),
        ("report.py", ". --out ../x", "--out=../x: leads out of the current folder; if that is meant, say /"),
        ("report.py", ". --out .", "--out=.: is the current folder; name one in it"),
        ("report.py", "nowhere", "nowhere: no such folder; give the folder of a run"),
        ("report.py", ". --seed -1", "--seed -1: must be at least 0"),
        ("export.py", "nowhere --to hub", "nowhere: no such folder; give the folder of a run"),
        ("export.py", ". --to hub --out ../x", "--out=../x: leads out of the current folder"),
        ("export.py", ". --to paper", "invalid choice: 'paper'"),
        ("benchmark.py", "--out ../x.json", "--out=../x.json: leads out of the current folder"),
        ("check.py", "", "the following arguments are required: algorithm"),
        ("check.py", "pong", "check pong: must be the import path of a class, e.g. my_package.MyPPO, or a"),
        ("check.py", "nowhere.PPO", "there is no module nowhere; is the folder that it is in on PYTHONPATH?"),
        ("check.py", "stable_baselines3.PPOO", "must be the import path of a BaseAlgorithm class"),
        ("check.py", "sarsa --probe luck", "--probe luck: there is no such probe; there are constant, "),
        ("check.py", "sarsa --set gamma=1", "--set gamma: each probe has its own; leave it out"),
        (
            "check.py",
            "sarsa --set momentum=1",
            "--set momentum: sarsa has no such argument; it has exploration",
        ),
        ("check.py", "sarsa --set learning_rate", "must be NAME=VALUE, e.g. learning_rate=0.001"),
        ("check.py", "dqn --set batch_size=big", "--set batch_size=big: must be int"),
        ("check.py", "sarsa --processes 0", "--processes 0: must be at least 1"),
        ("jobs.py", "nowhere", "nowhere: no such folder; give the folder of a sweep"),
        ("jobs.py", ".", "not a sweep's folder, it has no sweep.json"),
        ("jobs.py", ". --status lost", "invalid choice: 'lost'"),
        ("benchmark.py", "--fast", "unrecognized arguments: --fast"),
    ],
)
def test_the_other_scripts_refuse_too(name: str, line: str, words: str, tmp_path: Path) -> None:
    done = script(name, *line.split(), cwd=tmp_path, SDL_VIDEODRIVER="", DISPLAY="", WAYLAND_DISPLAY="")
    assert words in done.stderr.strip().splitlines()[-1]
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
