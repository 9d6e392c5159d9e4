"""Draw a finished run: episodes as numbered PNGs, GIF, APNG or MP4, and maps of what it learned."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from gridworld.base.console import printable, tell, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.safe_read import check_no_link
from gridworld.base.user_input import limited
from gridworld.commands import parser_of, whole
from gridworld.config.train import PICTURES
from gridworld.envs.rendering import frame_size
from gridworld.envs.rollout import play
from gridworld.run.folder import check_inside, check_writable
from gridworld.training.saved_run import SavedRun, choose_policy, read_visits
from gridworld.visualization import files
from gridworld.visualization.episode import film
from gridworld.visualization.picture import Subject, drawer

MAPS = {picture.name: picture.drawer for picture in PICTURES.values() if picture.is_map}


@limited()
def main(arguments: Sequence[str]) -> None:
    """Write the files and print their paths."""
    options = _parser().parse_args(arguments)
    if options.out is not None:
        check_inside(options.out, "--out")
    if "mp4" in options.format:
        files.require_video()
    with telling_if_slow(f"recording {options.run}"):
        _record(options)


def _record(options: argparse.Namespace) -> None:
    folder: Path = options.out or options.run / "recording"
    saved = SavedRun(options.run, options.trust, options.best)
    check_no_link(folder)
    check_writable(folder, "--out")
    if options.cell_size is not None:
        frame_size(saved.mdp, options.cell_size)
    formats = list(dict.fromkeys(options.format))
    evaluator, mdp, visits = saved.evaluator(), saved.mdp, None
    try:
        visits = read_visits(saved.run, mdp.probability.shape[:2])
    except InputError as error:  # the other pictures can be drawn without
        if "visits" in formats:
            raise
        tell(f"{error}; the pictures are drawn without")
    subject = Subject(saved.config, options.trust, evaluator, saved.snapshot(), saved.steps(), visits)
    drawn = {kind: drawer(MAPS[kind])(subject)(options.cell_size) for kind in formats if kind in MAPS}
    policy, limit = choose_policy(subject.snapshot, options.policy), evaluator.max_episode_steps
    episodes = [play(mdp, policy, limit, options.seed + index) for index in range(options.episodes)]
    animation = film(saved.config.env, mdp, episodes, options.trust, limit)(options.cell_size)
    files.check_size(animation, formats)
    folder.mkdir(parents=True, exist_ok=True)
    for kind in formats:
        path = folder / ("frames" if kind == "png" else f"{kind}.png" if kind in MAPS else f"episode.{kind}")
        if kind == "png":
            check_no_link(path)
        files.save(drawn.get(kind, animation), path, options.fps)
        print(printable(str(path)))


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(
        "record", __doc__, "run", "--policy", "--best", "--trust", example="runs/mine --format gif policy"
    )
    option = parser.add_argument
    kinds = f"any of {' '.join(files.FORMATS)} for episodes, {' '.join(MAPS)} for maps"
    kinds += " (default png gif; mp4 needs the extra `video`)"
    choices = (*files.FORMATS, *MAPS)
    option("--format", nargs="+", metavar="FORMAT", choices=choices, default=["png", "gif"], help=kinds)
    option("--cell-size", type=whole(2), help="pixels (default 100, 80 in maps, less on large worlds)")
    option("--fps", type=whole(1, 100), default=4, help="frames per second, 1 to 100 (default 4)")
    option("--episodes", type=whole(1, 1000), default=1, help="number of episodes (default 1)")
    option("--seed", type=whole(0), default=0, help="seed of the first episode (default 0)")
    option("--out", type=Path, help="the folder to write to (default RUN/recording)")
    return parser
