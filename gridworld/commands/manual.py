"""What `train --help` prints: its usage, and every choice with the first comment of its file.

Hydra's own help takes twice as long, since it loads every configuration to list their names.
"""

from __future__ import annotations

import textwrap
from pathlib import Path

from gridworld.config.words import conf_folder, pairs
from gridworld.process.console import as_called

_TEXT = """\
Train an agent on a GridWorld whose optimum is known exactly.

usage: python scripts/train.py [-m] [recipe=FILE] [group=choice ...] [key=value ...]
       python scripts/train.py resume=RUN [total_timesteps=N]

Choices:
{choices}

Keys, with their values: python scripts/train.py --cfg job
  seed, total_timesteps, n_envs, device, threads  the run itself
  exploration_bonus  what training pays for actions that were rarely taken; 0 for nothing
  agent.*, env.*, observation.*      what learns, in which world, and what it sees
  evaluation.*, logging.*, recording.*, checkpoint.*  what is computed and kept on the way
  hydra.run.dir  the folder to write to, instead of a new one in runs/

An interrupted run is resumed with resume=RUN, or when the same command meets its folder, and ends as if
nothing had happened. With resume=RUN beside it:
  total_timesteps=N       make the run longer, a finished one too
  trust=true              import classes that are neither ours nor one of the libraries'
  anyway=true             with other versions or another processor: the last bits may differ

An agent in a world for which it was tuned brings the recipe in by itself, below what the command line says;
tuned=none leaves it out, and preset=none the settings for stochastic and for large worlds.

What tune.py found, recipe=FILE (the study's folder, or the yaml in it), is read as data, whoever made it, and
what stands beside it goes before it; trust=true as above. --config-dir FOLDER is for yaml files of your own:
Hydra reads them, and they can have it run code.

Sweeps (-m):
  hydra.sweep.dir        the folder to write to; with the same one again, the sweep is resumed
  hydra/launcher=basic   one job at a time, in this process; else as many as there are cores, in forks of it
  hydra/launcher=joblib  the same in processes of their own; slurm and ray: on a cluster
  hydra.sweeper.paired=[agent,n_envs]  these lists vary together, not in every combination

Examples:
  python scripts/train.py agent=q_learning
      a table over the states, trained within a second
  python scripts/train.py agent=dqn env=four_rooms seed=3
      another world, with the recipe that was tuned for it; its folder in runs/ has the results
  python scripts/train.py -m agent=dqn,ppo "seed=range(20)" hydra.sweep.dir=runs/mine
      a sweep of forty runs, a folder each; look at them with tensorboard --logdir runs/mine
  python scripts/train.py resume=runs/mine
      resume a run that was interrupted
  python scripts/train.py recipe=runs/tune_ppo_maze seed=3
      the winner of a study

Afterwards: scripts/evaluate.py, scripts/record.py and scripts/play.py --agent, with a run's folder;
scripts/jobs.py, with a sweep's. Before: scripts/tune.py finds settings.
Hydra's own options: python scripts/train.py --hydra-help
"""


def manual() -> str:
    """The help text, with the choices in the folder of the yaml files."""
    conf, lines = conf_folder(), []
    # Spaces are tune.py's, and settings are chosen by the names of the presets.
    hidden = {conf, conf / "tune", conf / "preset" / "settings"}
    for group in sorted({file.parent for file in conf.glob("**/*.yaml")} - hidden):
        lines.append(f"  {group.relative_to(conf).as_posix()}=...")
        lines += _recipes(group) if group.name == "tuned" else choices(group)
    return as_called(_TEXT.format(choices="\n".join(lines)))


def choices(group: Path) -> list[str]:
    """A line for each yaml file in the folder of a group: its name and its first comment."""
    lines = []
    for file in sorted(group.glob("*.yaml")):
        comments = [line[2:] for line in file.read_text("utf-8").splitlines() if line.startswith("# ")]
        about = next((comment for comment in comments if not comment.startswith("@package")), "")
        lines.append(f"    {file.stem:<16} {about}")
    return lines


def _recipes(group: Path) -> list[str]:
    """A line or two per world, then those that are known to fail."""
    files = sorted(group.glob("*.yaml"))
    agents: dict[str, list[str]] = {}
    for file in files:
        world, agent = pairs().get(file.stem, ("", file.stem))
        agents.setdefault(world, []).append(agent)
    lines = []
    for world, names in agents.items():
        text = f"    {world + '_...' if world else '':<20} {', '.join(names)}"
        lines += textwrap.wrap(text, 100, subsequent_indent=" " * 25, drop_whitespace=True)
    failing = [file.stem for file in files if "known_failure:" in file.read_text("utf-8")]
    return [*lines, f"    Known to fail: {', '.join(failing)}"] if failing else lines
