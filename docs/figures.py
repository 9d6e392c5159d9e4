"""Makes the pictures in docs/images again: `python docs/figures.py`, some minutes."""

import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gridworld.report.chart import COLOURS, compact, house_style

IMAGES = Path(__file__).parent / "images"
SCRIPTS = Path(__file__).parents[1] / "scripts"

COMMANDS = """\
python scripts/train.py agent=dqn recording.cell_size=80 hydra.run.dir=one
python scripts/train.py -m agent=dqn,ppo 'seed=range(5)' evaluation.every=2000 hydra.sweep.dir=five
python scripts/report.py five --out report
python scripts/train.py agent=ppo_sb3_defaults total_timesteps=20000 hydra.run.dir=defaults
python scripts/train.py -m env=four_rooms agent=q_learning,sarsa 'seed=range(20)' hydra.sweep.dir=rooms
python scripts/report.py rooms --out rooms_report
python scripts/train.py agent=ppo hydra.run.dir=ppo
python scripts/train.py agent=ppo agent.learning_rate=0.3 hydra.run.dir=fast
"""
# By the name in docs/images: what is copied there; the last is drawn from three runs.
SOURCES = {
    "policy.png": "one/policy.png",
    "learning.gif": "one/learning.gif",
    "curve.png": "report/figures/classic_regret.png",
    "four_rooms.png": "rooms_report/figures/four_rooms_regret.png",
    "standing_still.png": "defaults/policy.png",
    "ppo_charts.png": "ppo_charts.png",
}
RUNS = {
    "ppo": "agent=ppo: certified",
    "defaults": "SB3's defaults: stands still",
    "fast": "a learning rate of 0.3: spoilt",
}
CHARTS = ("rollout/ep_rew_mean", "train/explained_variance", "train/approx_kl", "train/clip_fraction")


@house_style()
def draw_charts(folder: Path) -> None:
    """What TensorBoard shows of PPO in a good run and in two bad ones, over the share of their steps."""
    figure, axes = plt.subplots(1, len(CHARTS), figsize=(11, 2.6), layout="constrained")
    for (run, label), colour in zip(RUNS.items(), COLOURS, strict=False):
        events = EventAccumulator(str(folder / run))
        events.Reload()
        for axis, tag in zip(axes, CHARTS, strict=True):
            points = events.Scalars(tag)
            shares = [100 * each.step / points[-1].step for each in points]
            axis.plot(shares, [each.value for each in points], label=label, color=colour)
            axis.set(title=tag, xlabel="% of training")
    axes[1].set_ylim(-1, 1.05)  # the spoilt run's falls to -300
    axes[2].set_yscale("symlog", linthresh=0.01)
    axes[2].yaxis.set_major_formatter(compact)
    for axis in axes:
        axis.grid(axis="y")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(RUNS), frameon=False
    )
    path = folder / "ppo_charts.png"
    figure.savefig(path, dpi=120)
    Image.open(path).quantize(64).save(path, optimize=True)  # a third of the size


def main() -> None:
    """Run the commands in a temporary folder and copy what they drew."""
    with tempfile.TemporaryDirectory() as folder:
        for command in COMMANDS.splitlines():
            _, script, *words = shlex.split(command)
            subprocess.run([sys.executable, SCRIPTS / Path(script).name, *words], cwd=folder, check=True)
        draw_charts(Path(folder))
        for name, pattern in SOURCES.items():
            [source] = Path(folder).glob(pattern)
            shutil.copy(source, IMAGES / name)


if __name__ == "__main__":
    main()
