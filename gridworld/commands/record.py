"""Draw a finished run: its episodes as numbered PNGs, GIF, APNG or MP4, and maps of what it learnt."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gridworld.commands import parser_for_a_run, whole_number
from gridworld.config.pictures import PICTURES
from gridworld.envs.frames.rendering import frame_size
from gridworld.envs.rollout import play
from gridworld.errors import InputError
from gridworld.process.console.command_line import program
from gridworld.process.console.progress import telling_if_slow
from gridworld.process.console.terminal import printable
from gridworld.process.memory_budget import limited
from gridworld.restore.saved_run import SavedRun, choose_policy, read_visits
from gridworld.run.claim import check_inside, check_writable
from gridworld.storage.safe_read import check_no_link
from gridworld.storage.symlinks import make_inside
from gridworld.visualization import files
from gridworld.visualization.episode import film
from gridworld.visualization.picture import drawer
from gridworld.world.exact.evaluation import Evaluator

MAPS = {picture.name: picture.drawer for picture in PICTURES if picture.is_map}


@limited()
def main(arguments: Sequence[str]) -> None:
    """Write the files and print their paths."""
    options = _parser().parse_args(arguments)
    _check(options)
    with telling_if_slow(f"recording {options.run}"):
        _record(options)


class _SavedSubject:
    """See `visualization.picture.Subject`; a file of the run is read when it is asked for."""

    history = None

    def __init__(self, saved: SavedRun, is_trusted: bool) -> None:
        self._saved, self.is_trusted = saved, is_trusted
        self.config = saved.config
        self.snapshot = saved.snapshot()

    @cached_property
    def evaluator(self) -> Evaluator:
        return self._saved.evaluator()

    @cached_property
    def steps(self) -> int:
        return self._saved.steps()

    @cached_property
    def visits(self) -> NDArray[np.int64]:
        return read_visits(self._saved.run, self._saved.mdp.probability.shape[:2])


def _record(options: argparse.Namespace) -> None:
    folder: Path = options.out or options.run / "recording"
    saved = SavedRun(options.run, options.trust, options.best)
    check_no_link(folder)
    check_writable(folder, "--out")
    if options.cell_size is not None:
        frame_size(saved.mdp, options.cell_size)
    formats = list(dict.fromkeys(options.format))
    subject = _SavedSubject(saved, options.trust)
    drawn = {kind: drawer(MAPS[kind]).draw(subject)(options.cell_size) for kind in formats if kind in MAPS}
    policy, limit = choose_policy(subject.snapshot, options.policy), subject.evaluator.max_episode_steps
    seeds = range(options.seed, options.seed + options.episodes)
    played = [play(saved.mdp, policy, limit, seed) for seed in seeds]
    episodes = film(saved.config.env, saved.mdp, played, options.trust)(options.cell_size)
    files.check_size(episodes, formats)
    if options.out is None:
        make_inside(options.run, folder.name)
    else:
        folder.mkdir(parents=True, exist_ok=True)
    for kind in formats:
        if kind == "png":
            path = folder / "frames"
            check_no_link(path)
        else:
            path = folder / (f"{kind}.png" if kind in MAPS else f"episode.{kind}")
        files.save(drawn.get(kind, episodes), path, options.fps)
        print(printable(str(path)))


def _parser() -> argparse.ArgumentParser:
    parser = parser_for_a_run(program("record"), __doc__)
    parser.add_argument(
        "--format",
        nargs="+",
        choices=(*files.FORMATS, *MAPS),
        default=["png", "gif"],
        help=f"one or more of {' '.join(files.FORMATS)} for episodes, {' '.join(MAPS)} for maps "
        "(default png gif; mp4 needs the extra `video`)",
    )
    parser.add_argument(
        "--cell-size", type=whole_number, help="pixels (default 100, 80 in maps, less on large worlds)"
    )
    parser.add_argument("--fps", type=whole_number, default=4, help="frames a second, 1 to 100 (default 4)")
    parser.add_argument("--episodes", type=whole_number, default=1, help="one after the other (default 1)")
    parser.add_argument("--seed", type=whole_number, default=0, help="of the first episode (default 0)")
    parser.add_argument("--out", type=Path, help="the folder to write to (default RUN/recording)")
    return parser


def _check(options: argparse.Namespace) -> None:
    if not 1 <= options.fps <= 100:
        raise InputError(f"--fps {options.fps}: must be from 1 to 100")
    if not 1 <= options.episodes <= 1000:
        raise InputError(f"--episodes {options.episodes}: must be from 1 to 1000")
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: must be at least 0")
    if options.cell_size is not None and options.cell_size < 2:
        raise InputError(f"--cell-size {options.cell_size}: must be at least 2 pixels")
    if options.out is not None:
        check_inside(options.out, "--out")
    if "mp4" in options.format:
        files.require_video()
