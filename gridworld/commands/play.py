"""Play a world yourself, alone or next to a trained agent, and see how far you are from optimal.

The agent takes a step whenever you do, and continues alone when your episode is over.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gridworld.commands import parser_of, whole
from gridworld.config.compose import compose
from gridworld.config.train import EvaluationConfig
from gridworld.config.worlds import MapConfig
from gridworld.envs import rendering as drawing
from gridworld.envs.env import GridWorldEnv
from gridworld.envs.rendering import Frame
from gridworld.errors import InputError
from gridworld.process.console import printable, program, telling_if_slow
from gridworld.process.user_input import limited
from gridworld.restore.saved_run import SavedRun
from gridworld.storage.serialization import independent_generator
from gridworld.visualization.canvas import Canvas
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import GridMdp
from gridworld.world.mdp import FloatArray

_SAME = 1e-9  # returns that differ by rounding alone
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


class Player:
    """An episode in progress and its return so far; an agent's has a policy, (S, A), and a step limit."""

    def __init__(
        self, evaluator: Evaluator, name: str, policy: FloatArray | None = None, limit: int | None = None
    ) -> None:
        self.evaluator, self.name = evaluator, name
        self._policy, self._limit = policy, limit
        self._env = GridWorldEnv(mdp=evaluator.mdp)
        self.state = self.steps = 0
        self.value = self.optimum = 0.0  # discounted return so far, and the best expected from the start
        self.over = False

    def restart(self, seed: int) -> None:
        """Start an episode; players with the same seed start in the same cell."""
        self.state, _ = self._env.reset(seed=seed)
        self._chance = independent_generator(seed)  # the world uses the seed's own generator
        self.steps, self.value, self.over = 0, 0.0, False
        self.optimum = float(self.evaluator.solution.v[self.state])

    def act(self) -> None:
        """Take an action of the policy, if there is one."""
        if self._policy is not None:
            row = self._policy[self.state]
            self.step(int(self._chance.choice(len(row), p=row)))

    def step(self, action: int) -> None:
        """Take an action, unless the episode is over."""
        if self.over:
            return
        self.state, reward, ended, _, _ = self._env.step(action)
        self.value += self.evaluator.solution.gamma**self.steps * reward
        self.steps += 1
        self.over = ended or self.steps == self._limit

    def standing(self) -> str:
        """The player's name, steps and return, and the optimum."""
        return f"{self.name}: {self._taken()}, return {self.value:.4g}, optimum {self.optimum:.4g}"

    def verdict(self) -> str:
        """How the finished episode compares with the optimum."""
        mdp, missing = self.evaluator.mdp, self.optimum - self.value
        where = "goal" if mdp.goal[self.state] else "trap" if mdp.trap[self.state] else "no end"
        if mdp.next_state.shape[2] > 1:
            luck = "more" if missing < 0 else "less"
            result = f"{abs(missing):.4g} {luck} than the best policy gets on average"
        elif missing <= _SAME * max(1.0, abs(self.optimum)):
            result = "nobody could do better"
        else:
            result = f"{missing:.4g} less than the optimum"
        return f"{where} after {self._taken()}: {result}"

    def _taken(self) -> str:
        return "1 step" if self.steps == 1 else f"{self.steps} steps"


class Game:
    """A person's board and perhaps an agent's; a restart adds 1 to the seed of the start and the slips."""

    def __init__(self, evaluator: Evaluator, seed: int = 0, agent: Player | None = None) -> None:
        self.person = Player(evaluator, "you")
        self.players = [self.person] if agent is None else [self.person, agent]
        self._seed = seed - 1
        self.restart()

    @property
    def over(self) -> bool:
        """Whether all episodes are over."""
        return all(player.over for player in self.players)

    def restart(self) -> None:
        """Start the next episodes, from the same cell."""
        self._seed += 1
        for player in self.players:
            player.restart(self._seed)

    def move(self, action: int) -> None:
        """Take the person's action, and the agent's."""
        if not self.person.over:
            self.person.step(action)
            self.players[-1].act()

    def tick(self) -> None:
        """Let the agent take a step if the person's episode is over."""
        if self.person.over:
            self.players[-1].act()


def draw(game: Game, cell_size: int) -> Frame:
    """Draw the boards side by side, uint8 (height, width, 3), with their standings, and verdicts or keys."""
    boards = []
    for player in game.players:
        canvas = Canvas(player.evaluator.mdp, cell_size)
        drawing.draw_world(canvas.world, player.evaluator.mdp, player.state, cell_size)
        canvas.caption(player.standing())
        keys = "arrow keys move, R restarts, Q quits" if player is game.person else ""
        canvas.footer(player.verdict() if player.over else keys)
        boards.append(canvas.frame())
    return np.concatenate(boards, axis=1)


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
    actions = {pygame.K_UP: 0, pygame.K_RIGHT: 1, pygame.K_DOWN: 2, pygame.K_LEFT: 3}
    pygame.display.init()
    window: Any = None
    clock, frames, is_told, goes_on = pygame.time.Clock(), 0, False, True
    try:
        while goes_on:
            frame = draw(game, cell_size)
            size = (frame.shape[1], frame.shape[0])
            if window is None:
                window = pygame.display.set_mode(size)
                pygame.display.set_caption(printable(f"GridWorld: {game.person.evaluator.mdp.name}"))
            window.blit(pygame.image.frombuffer(frame, size, "RGB"), (0, 0))
            pygame.display.flip()
            clock.tick(_FPS)
            for event in pygame.event.get():
                key = event.key if event.type == pygame.KEYDOWN else None
                if event.type == pygame.QUIT or key in (pygame.K_q, pygame.K_ESCAPE):
                    goes_on = False
                elif key == pygame.K_r:
                    game.restart()
                elif key in actions:
                    game.move(actions[key])
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
    option("words", nargs="*", metavar="env=NAME", help="the world, as for train: env=cliff env.slip=0.1")
    option("--layout", help="a shipped map's name or a map file (default classic)")
    for name, (kind, meaning) in _WORLD.items():
        option(f"--{name.replace('_', '-')}", type=kind, help=meaning)
    option("--gamma", type=float, help="discount of returns, 0 to 1 (default 0.99)")
    option("--seed", type=whole(0), default=0, help="of starts and slips (default 0)")
    option("--cell-size", type=whole(8), help="pixels (default 100, less on large maps)")
    option("--agent", type=Path, metavar="RUN", help="a finished run, whose agent plays next to you")
    return parser


def _game(options: argparse.Namespace) -> Game:
    """A game in the world of the options; with an agent, its run's settings are the defaults."""
    given = {name: getattr(options, name) for name in _WORLD if getattr(options, name) is not None}
    if options.agent is None:
        env = compose(options.words).env if options.words else MapConfig()
        if not isinstance(env, MapConfig):
            raise InputError(f"{env.name}: has no map to draw; give env=... of a map, such as env=four_rooms")
        env = dataclasses.replace(
            env, **given, **({} if options.layout is None else {"layout": options.layout})
        )
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
    agent = Player(evaluator, config.agent.name, policy, evaluator.max_episode_steps)
    return Game(evaluator, options.seed, agent)
