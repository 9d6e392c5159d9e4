"""Export episodes of a finished run as pictures: numbered PNGs, GIF, APNG, MP4."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gridworld import record
from gridworld.commands import parser_for_a_run
from gridworld.errors import InputError
from gridworld.evaluation import play_episode
from gridworld.render import frame_size
from gridworld.saved_run import SavedRun, choose_policy


def main(arguments: Sequence[str]) -> None:
    """Write the files and name them."""
    options = _parser().parse_args(arguments)
    _check(options)
    saved = SavedRun(options.run, options.trust)
    if options.cell_size is not None:
        frame_size(saved.mdp, options.cell_size)
    policy = choose_policy(saved.beliefs(), options.policy)
    episodes = [
        play_episode(saved.mdp, policy, saved.config.env.max_episode_steps, options.seed + index)
        for index in range(options.episodes)
    ]
    frames = record.draw_states(saved.mdp, np.concatenate(episodes), options.cell_size)
    folder: Path = options.out or options.run / "recording"
    folder.mkdir(parents=True, exist_ok=True)
    for kind in dict.fromkeys(options.format):
        if kind == "png":
            record.save_pngs(frames, folder / "frames")
            print(folder / "frames")
        else:
            record.save_animation(frames, folder / f"episode.{kind}", options.fps)
            print(folder / f"episode.{kind}")


def _parser() -> argparse.ArgumentParser:
    parser = parser_for_a_run("record.py", __doc__)
    parser.add_argument(
        "--format",
        nargs="+",
        choices=record.FORMATS,
        default=["png", "gif"],
        help="one or more of png gif apng mp4 (default png gif; mp4 needs the extra `video`)",
    )
    parser.add_argument("--cell-size", type=int, help="pixels (default 100, less on large maps)")
    parser.add_argument("--fps", type=int, default=4, help="frames a second, 1 to 100 (default 4)")
    parser.add_argument("--episodes", type=int, default=1, help="one after the other (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode (default 0)")
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
    if "mp4" in options.format:
        record.require_video()
