"""Play a world with the arrow keys, alone or beside a trained agent, and see how far you are from optimal."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gridworld.commands import parser_of, whole
from gridworld.commands.game import Game, Key, draw
from gridworld.config.train import EvaluationConfig
from gridworld.config.worlds import MapConfig
from gridworld.envs import rendering as drawing
from gridworld.errors import InputError
from gridworld.process.console import printable, program, telling_if_slow
from gridworld.process.memory_budget import limited
from gridworld.restore.saved_run import SavedRun
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import GridMdp

_WIDEST_BOARD = 800  # pixels; two boards share twice 640
_FPS = 30
_TICKS = 5  # frames between two steps of an agent that continues alone
_WORLD: dict[str, tuple[Any, str]] = {  # a setting of the world: its type, and what it is
    "num_rows": (whole(), "of the layout classic (default 5)"),
    "num_cols": (whole(), "of the layout classic (default 6)"),
    "slip": (float, "probability of slipping aside (default 0)"),
    "step_reward": (float, "paid for every step (default 0)"),
    "goal_reward": (float, "paid for entering a goal (default 1)"),
    "trap_reward": (float, "paid for entering a trap (default -1)"),
}


@limited()
def main(arguments: Sequence[str]) -> None:
    """Open the window and play until it is closed."""
    options = _parser().parse_args(arguments)
    if options.best and options.agent is None:
        raise InputError("--best: chooses between the models of a run; add --agent RUN")
    with telling_if_slow("solving the world"):
        game = _game(options)
    mdp, boards = game.person.evaluator.mdp, len(game.players)
    cell_size = options.cell_size or drawing.fitting_cell_size(mdp, _WIDEST_BOARD if boards == 1 else 640)
    drawing.frame_size(mdp, cell_size)
    if not drawing.has_display():
        raise InputError(f"{program('play')}: there is no display to open a window on; set DISPLAY")
    play(game, cell_size)


def play(game: Game, cell_size: int) -> None:
    """Show a game and pass it the keys until the person quits; print the verdict on every episode."""
    pygame = drawing.import_pygame()
    keys = {getattr(pygame, f"K_{key.name}"): key for key in (Key.UP, Key.RIGHT, Key.DOWN, Key.LEFT)}
    keys |= {pygame.K_r: Key.RESTART, pygame.K_q: Key.QUIT, pygame.K_ESCAPE: Key.QUIT}
    pygame.display.init()
    window: Any = None
    clock, frames, is_told = pygame.time.Clock(), 0, False
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
            frames += 1
            if frames % _TICKS == 0:
                game.tick()
            if game.over and not is_told:
                for player in game.players:
                    print(printable(f"{player.standing()}; {player.verdict()}"), flush=True)
            is_told = game.over
    finally:
        pygame.quit()


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("play", __doc__, "--best")
    option = parser.add_argument
    option("--layout", help="a shipped map's name or a map file (default classic)")
    for name, (kind, meaning) in _WORLD.items():
        option(f"--{name.replace('_', '-')}", type=kind, help=meaning)
    option("--gamma", type=float, help="discount of returns, 0 to 1 (default 0.99)")
    option("--seed", type=whole(0), default=0, help="of starts and slips (default 0)")
    option("--cell-size", type=whole(8), help="pixels (default 100, less on large maps)")
    option("--agent", type=Path, metavar="RUN", help="a finished run, whose agent plays beside you")
    return parser


def _game(options: argparse.Namespace) -> Game:
    """A game in the world of the options; with an agent, its run's settings are the defaults."""
    given = {name: getattr(options, name) for name in _WORLD if getattr(options, name) is not None}
    if options.agent is None:
        env = MapConfig(**given, **({} if options.layout is None else {"layout": options.layout}))
        mdp = env.compile()
        gamma = EvaluationConfig().gamma if options.gamma is None else options.gamma
        return Game(Evaluator(mdp, gamma, env.step_limit(mdp)), options.seed)
    if "num_rows" in given or "num_cols" in given:
        raise InputError("--num-rows, --num-cols: with --agent, the world has the size it was trained on")
    saved = SavedRun(options.agent, best=options.best)
    config, world = saved.config, saved.evaluator(options.layout).mdp
    if not isinstance(config.env, MapConfig) or not isinstance(world, GridMdp):
        raise InputError(f"--agent {options.agent}: was trained on {config.env.name}, not a map")
    mdp = dataclasses.replace(config.env, **given).compile_on(world.layout)
    gamma = config.evaluation.gamma if options.gamma is None else options.gamma
    evaluator, policy = Evaluator(mdp, gamma, config.env.step_limit(mdp)), saved.snapshot().greedy_policy()
    return Game(evaluator, options.seed, policy, config.agent.name, evaluator.max_episode_steps)
