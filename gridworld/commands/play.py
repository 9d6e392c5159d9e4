"""Play a world with the arrow keys, alone or beside a trained agent, and see how far you are from optimal."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gridworld.commands import add_best, whole_number
from gridworld.commands.game import Game, Key, draw
from gridworld.config.train import EvaluationConfig
from gridworld.config.worlds import MapConfig
from gridworld.envs import rendering as drawing
from gridworld.errors import InputError
from gridworld.process.console.command_line import program
from gridworld.process.console.progress import telling_if_slow
from gridworld.process.console.terminal import printable
from gridworld.process.memory_budget import limited
from gridworld.restore.saved_run import SavedRun
from gridworld.world.exact.evaluation import Evaluator
from gridworld.world.grid import GridMdp

_WIDEST_BOARD = 800  # pixels; two boards share twice 640
_FPS = 30
_TICKS = 5  # frames between two steps of an agent that goes on alone
_WORLD = ("num_rows", "num_cols", "slip", "step_reward", "goal_reward", "trap_reward")


@limited()
def main(arguments: Sequence[str]) -> None:
    """Open the window and play until it is closed."""
    options = _parser().parse_args(arguments)
    _check(options)
    with telling_if_slow("solving the world"):
        game = _game(options)
    mdp, boards = game.person.evaluator.mdp, len(game.players)
    cell_size = options.cell_size or drawing.fitting_cell_size(mdp, _WIDEST_BOARD if boards == 1 else 640)
    drawing.frame_size(mdp, cell_size)
    if not drawing.has_display():
        raise InputError(f"{program('play')}: there is no display to open a window on; set DISPLAY")
    play(game, cell_size)


def play(game: Game, cell_size: int) -> None:
    """Show a game and pass it the keys until the person quits; prints the verdict on every episode.

    Args:
        game: The game.
        cell_size: In pixels.
    """
    pygame = drawing.import_pygame()
    keys = {
        pygame.K_UP: Key.UP,
        pygame.K_RIGHT: Key.RIGHT,
        pygame.K_DOWN: Key.DOWN,
        pygame.K_LEFT: Key.LEFT,
        pygame.K_r: Key.RESTART,
        pygame.K_q: Key.QUIT,
        pygame.K_ESCAPE: Key.QUIT,
    }
    pygame.display.init()
    window: Any = None
    clock, passed, told = pygame.time.Clock(), 0, False
    try:
        while not game.quit:
            frame = draw(game, cell_size)
            size = (frame.shape[1], frame.shape[0])
            if window is None:
                window = pygame.display.set_mode(size)
                pygame.display.set_caption(printable(f"GridWorld: {game.person.evaluator.mdp.name}"))
            window.blit(pygame.image.frombuffer(frame, size, "RGB"), (0, 0))
            pygame.display.flip()
            clock.tick(_FPS)
            for event in pygame.event.get():
                if event.type == pygame.QUIT:
                    game.press(Key.QUIT)
                elif event.type == pygame.KEYDOWN and event.key in keys:
                    game.press(keys[event.key])
            passed += 1
            if passed % _TICKS == 0:
                game.tick()
            if game.over and not told:
                for player in game.players:
                    print(printable(f"{player.standing()}; {player.verdict()}"), flush=True)
            told = game.over
    finally:
        pygame.quit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=program("play"), description=__doc__)
    parser.add_argument("--layout", help="a shipped map's name or a map file (default classic)")
    parser.add_argument("--num-rows", type=whole_number, help="of the layout classic (default 5)")
    parser.add_argument("--num-cols", type=whole_number, help="of the layout classic (default 6)")
    parser.add_argument("--slip", type=float, help="probability of slipping aside (default 0)")
    parser.add_argument("--step-reward", type=float, help="paid for every step (default 0)")
    parser.add_argument("--goal-reward", type=float, help="paid for entering a goal (default 1)")
    parser.add_argument("--trap-reward", type=float, help="paid for entering a trap (default -1)")
    parser.add_argument("--gamma", type=float, help="discount of returns, 0 to 1 (default 0.99)")
    parser.add_argument("--seed", type=whole_number, default=0, help="of starts and slips (default 0)")
    parser.add_argument("--cell-size", type=whole_number, help="pixels (default 100, less on large maps)")
    parser.add_argument(
        "--agent", type=Path, metavar="RUN", help="a finished run: its agent plays beside you, in its world"
    )
    add_best(parser)
    return parser


def _check(options: argparse.Namespace) -> None:
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: must be at least 0")
    if options.best and options.agent is None:
        raise InputError("--best: chooses between the models of a run; add --agent RUN")
    if options.cell_size is not None and options.cell_size < 8:
        raise InputError(f"--cell-size {options.cell_size}: must be at least 8 pixels")


def _game(options: argparse.Namespace) -> Game:
    """A game in the world of the options; with an agent, its run's settings are the defaults."""
    given = {name: getattr(options, name) for name in _WORLD if getattr(options, name) is not None}
    if options.agent is None:
        if options.layout is not None:
            given["layout"] = options.layout
        gamma = EvaluationConfig().gamma if options.gamma is None else options.gamma
        env = MapConfig(**given)
        mdp = env.compile()
        return Game(Evaluator(mdp, gamma, env.step_limit(mdp)), options.seed)
    if "num_rows" in given or "num_cols" in given:
        raise InputError("--num-rows, --num-cols: with --agent, the world has the size it was trained on")
    saved = SavedRun(options.agent, best=options.best)
    config, world = saved.config, saved.evaluator(options.layout).mdp
    if not isinstance(config.env, MapConfig) or not isinstance(world, GridMdp):
        raise InputError(f"--agent {options.agent}: was trained on {config.env.name}, which is no map")
    env = dataclasses.replace(config.env, **given)
    mdp = env.compile_on(world.layout)
    gamma = config.evaluation.gamma if options.gamma is None else options.gamma
    policy = saved.snapshot().greedy_policy()
    evaluator = Evaluator(mdp, gamma, env.step_limit(mdp))
    return Game(evaluator, options.seed, policy, config.agent.name, evaluator.max_episode_steps)
