"""Makes the pictures in docs/images again: `python docs/figures.py`, some minutes."""

import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

IMAGES = Path(__file__).parent / "images"
SCRIPTS = Path(__file__).parents[1] / "scripts"

COMMANDS = """\
python scripts/train.py agent=dqn recording.cell_size=80 hydra.run.dir=one
python scripts/train.py -m agent=dqn,ppo 'seed=range(5)' evaluation.every=2000 hydra.sweep.dir=five
python scripts/report.py five --out report
python scripts/train.py agent=ppo_sb3_defaults total_timesteps=20000 hydra.run.dir=defaults
python scripts/train.py -m env=four_rooms agent=q_learning,sarsa 'seed=range(20)' hydra.sweep.dir=rooms
python scripts/report.py rooms --out rooms_report
"""
# By the name in docs/images: what is copied there.
SOURCES = {
    "policy.png": "one/policy.png",
    "learning.gif": "one/learning.gif",
    "curve.png": "report/figures/classic_regret.png",
    "four_rooms.png": "rooms_report/figures/four_rooms_regret.png",
    "standing_still.png": "defaults/policy.png",
}


def main() -> None:
    """Run the commands in a temporary folder and copy what they drew."""
    with tempfile.TemporaryDirectory() as folder:
        for command in COMMANDS.splitlines():
            _, script, *words = shlex.split(command)
            subprocess.run([sys.executable, SCRIPTS / Path(script).name, *words], cwd=folder, check=True)
        for name, pattern in SOURCES.items():
            [source] = Path(folder).glob(pattern)
            shutil.copy(source, IMAGES / name)


if __name__ == "__main__":
    main()
