"""What `train --help` prints: its usage, and every choice with the first comment of its file.

Hydra's own help takes twice as long, since it loads every configuration to list their names.
"""

from __future__ import annotations

from pathlib import Path

from gridworld.commands import folded
from gridworld.config.words import conf_folder

_TEXT = """\
Train an agent on a GridWorld whose optimum is known exactly.

usage: python scripts/train.py [-m] [recipe=FILE] [group=choice ...] [key=value ...]
       python scripts/train.py resume=RUN [total_timesteps=N]

Choices:
{choices}

Keys (all of them, with their values: python scripts/train.py --cfg job):
  seed, total_timesteps, n_envs, device, threads      the run itself
  agent.*, env.*, observation.*                       the agent, its world, and what it observes
  exploration_bonus                                   extra reward in training for rarely taken actions
  evaluation.*, logging.*, recording.*, checkpoint.*  what is computed and saved during training
  hydra.run.dir                                       the run's folder, instead of a new one in runs/

Resume an interrupted run with resume=RUN, or by running the same command with the same folder; it ends as if
it had never been interrupted. Options of resume=RUN:
  total_timesteps=N       make the run longer, even a finished one
  trust=true              import classes from any package
  anyway=true             resume with other versions or on another processor; the last bits may differ

An agent uses the recipe that was tuned for it in the world, or for stochastic or large worlds where it has
none or slips are added; the command line overrides it. tuned=none leaves recipes out.

recipe=FILE uses what tune.py found: a study's folder, or the yaml file in it. It is read as data, so results
of strangers are safe; the command line overrides them. --config-dir FOLDER adds your own yaml files; Hydra
reads them, and they can run code.

Sweeps (-m):
  hydra.sweep.dir        the sweep's folder; the same folder again resumes the sweep
  hydra/launcher=forks   the default: as many jobs at a time as there are cores, in forks of this process
  hydra/launcher=basic   one job at a time, in this process
  hydra/launcher=joblib  parallel jobs in new processes; on a cluster: slurm, ray
  hydra.sweeper.paired=[agent,n_envs]  these lists vary together instead of in every combination

Next: scripts/evaluate.py, scripts/record.py and scripts/play.py --agent take a run's folder, scripts/jobs.py
a sweep's. To find settings: scripts/tune.py.

Hydra's own options: python scripts/train.py --hydra-help

Examples:
  python scripts/train.py agent=q_learning
      a table over the states, trained in a second
  python scripts/train.py agent=dqn env=four_rooms seed=3
      another world, with the recipe tuned for it; its folder in runs/ has the results
  python scripts/train.py -m agent=dqn,ppo "seed=range(20)" hydra.sweep.dir=runs/mine
      a sweep of forty runs in a folder each; see them with tensorboard --logdir runs/mine
  python scripts/train.py resume=runs/mine
      resume an interrupted run
  python scripts/train.py recipe=runs/tune_ppo_maze seed=3
      train with the winner of a study
"""


def manual() -> str:
    """The help text, with the choices in the folder of the yaml files."""
    conf, lines = conf_folder(), []
    # Spaces are tune.py's, and recipes are in a folder for each agent.
    hidden = {conf, conf / "tune", *(conf / "tuned").iterdir()}
    for group in sorted({file.parent for file in conf.glob("**/*.yaml")} - hidden):
        lines.append(f"  {group.relative_to(conf).as_posix()}=...")
        lines += _recipes(group) if group.name == "tuned" else choices(group)
    return folded(_TEXT.format(choices="\n".join(lines)))


def choices(group: Path) -> list[str]:
    """A line for each yaml file in the folder of a group: its name and its first comment."""
    lines, files = [], sorted(group.glob("*.yaml"))
    width = max((len(file.stem) for file in files), default=0)
    for file in files:
        comments = [line[2:] for line in file.read_text("utf-8").splitlines() if line.startswith("# ")]
        about = next((comment for comment in comments if not comment.startswith("@package")), "")
        lines.append(f"    {file.stem:<{width}}  {about}")
    return lines


def _recipes(group: Path) -> list[str]:
    """A line or two per agent, then those that are known to fail."""
    lines = choices(group)
    files = sorted(group.glob("*/*.yaml"))
    for agent in sorted({file.parent.name for file in files}):
        names = [file.stem for file in files if file.parent.name == agent]
        lines.append(f"    {agent + '/...':<18}  {', '.join(names)}")
    failing = [file for file in files if "known_failure:" in file.read_text("utf-8")]
    names = [file.relative_to(group).with_suffix("").as_posix() for file in failing]
    return [*lines, f"    Known to fail: {', '.join(names)}"]
