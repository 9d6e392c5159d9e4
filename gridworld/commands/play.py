"""Play a world yourself, alone or next to a trained agent, and see how far you are from optimal.

The agent takes a step whenever you do, and continues alone when your episode is over. O shows the optimal
policy, by arrows over a map, in words above a picture of Gymnasium's.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gridworld.base.console import printable, program, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.serialization import independent_generator
from gridworld.base.user_input import limited
from gridworld.commands import parser_of, whole
from gridworld.config.compose import compose
from gridworld.config.train import EvaluationConfig
from gridworld.config.words import refuse_unclear
from gridworld.config.worlds import GymnasiumConfig, MapConfig
from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import Frame
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.training.saved_run import SavedRun
from gridworld.visualization.canvas import Canvas
from gridworld.visualization.episode import RealEnv
from gridworld.visualization.maps import draw_optimal_actions
from gridworld.visualization.sheet import Sheet
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import GridMdp
from gridworld.world.mdp import FloatArray, Mdp

_SAME = 1e-9  # returns that differ by rounding alone
_WIDEST_BOARD = 800  # pixels; two boards share twice 640
_BORDER = 30  # pixels around a picture of Gymnasium's
_LEAST_PICTURE = 500  # pixels, to which a smaller one is about enlarged
_FPS = 30
_TICKS = 5  # frames between two steps of an agent that continues alone
_ARROWS = {"up": "up north forward", "right": "right east", "down": "down south", "left": "left west"}
_WORLD: dict[str, tuple[Any, str]] = {  # a setting of a map's world: its type, and what it is
    "num_rows": (whole(), "rows of the layout classic (default 5)"),
    "num_cols": (whole(), "columns of the layout classic (default 6)"),
    "slip": (float, "probability of slipping aside (default 0)"),
    "step_reward": (float, "paid for every step (default 0)"),
    "goal_reward": (float, "paid for entering a goal (default 1)"),
    "trap_reward": (float, "paid for entering a trap (default -1)"),
}


class Player:
    """An episode in progress and its return so far; an agent's has a policy, (S, A)."""

    def __init__(
        self,
        evaluator: Evaluator,
        name: str,
        policy: FloatArray | None = None,
        limit: int | None = None,
        real: RealEnv | None = None,
    ) -> None:
        self.evaluator, self.name, self.real = evaluator, name, real
        self._policy = policy
        self._env = GridWorldVectorEnv(max_episode_steps=limit, autoreset_mode="Disabled", mdp=evaluator.mdp)
        self.state = self.steps = 0
        self.total = 0.0  # the return so far
        self.value = self.optimum = 0.0  # the same, discounted, and the best expected from the start
        self.over = False

    def restart(self, seed: int) -> None:
        """Start an episode; players with the same seed start in the same state."""
        self.state = int(self._env.reset(seed=seed)[0][0])
        self._chance = independent_generator(seed)  # the world uses the seed's own generator
        self.steps, self.total, self.value, self.over = 0, 0.0, 0.0, False
        self.optimum = float(self.evaluator.solution.v[self.state])
        if self.real is not None:
            self.real.reset(self.state)

    def act(self) -> None:
        """Take an action of the policy, if there is one."""
        if self._policy is not None:
            row = self._policy[self.state]
            self.step(int(self._chance.choice(len(row), p=row)))

    def step(self, action: int) -> None:
        """Take an action, unless the episode is over."""
        if self.over:
            return
        states, rewards, terminated, truncated, _ = self._env.step(np.array([action]))
        self.state, self.over = int(states[0]), bool(terminated[0] or truncated[0])
        self.total += float(rewards[0])
        self.value += self.evaluator.solution.gamma**self.steps * float(rewards[0])
        self.steps += 1
        if self.real is not None:
            self.real.follow(self.state, action)

    def standing(self) -> str:
        """The player's name, steps and return, also discounted, as the optimum is."""
        result = f"return {self.total:.4g}, discounted {self.value:.4g}, optimum {self.optimum:.4g}"
        return f"{self.name}: {self._taken()}, {result}"

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
    """A person's board and perhaps an agent's; a restart adds 1 to the seed of the start and the slips.

    `real` shows the person's states, of a world of Gymnasium's. On a map the person has no step limit.
    """

    def __init__(
        self, evaluator: Evaluator, seed: int = 0, agent: Player | None = None, real: RealEnv | None = None
    ) -> None:
        limit = None if isinstance(evaluator.mdp, GridMdp) else evaluator.max_episode_steps
        self.person = Player(evaluator, "you", limit=limit, real=real)
        self.players = [self.person] if agent is None else [self.person, agent]
        self.keys, self.shows_optimum = _keys(evaluator.mdp), False
        self._seed = seed - 1
        self.restart()

    @property
    def over(self) -> bool:
        """Whether all episodes are over."""
        return all(player.over for player in self.players)

    def restart(self) -> None:
        """Start the next episodes, from the same state."""
        self._seed += 1
        for player in self.players:
            player.restart(self._seed)

    def move(self, action: int) -> None:
        """Take the person's action, and the agent's."""
        if not self.person.over:
            self.person.step(action)
            self.players[-1].act()

    def press(self, key: str) -> bool:
        """Do what the key of this name does; whether the game continues."""
        if key == "r":
            self.restart()
        elif key == "o":
            self.shows_optimum = not self.shows_optimum
        elif key in self.keys:
            self.move(self.keys[key])
        return key not in ("q", "escape")

    def legend(self) -> str:
        """What the keys do."""
        mdp = self.person.evaluator.mdp
        digits = [f"{key}: {mdp.action_names[self.keys[key]]}" for key in self.keys.keys() - _ARROWS.keys()]
        moves = ["arrow keys: move"] if len(digits) < len(self.keys) else []
        return ", ".join([*moves, *sorted(digits), "O: optimal policy", "R: restart", "Q: quit"])


def _keys(mdp: Mdp) -> dict[str, int]:
    """The actions by the names of their keys: arrows for moves, digits for the others."""
    arrows = {word: key for key, words in _ARROWS.items() for word in words.split()}
    moves = {arrows[name]: action for action, name in enumerate(mdp.action_names) if name in arrows}
    others = [action for action in range(mdp.num_actions) if action not in moves.values()]
    if len(others) > 9:
        raise InputError(f"{mdp.name}: has {mdp.num_actions} actions, more than there are keys for")
    return moves | {str(number): action for number, action in enumerate(others, start=1)}


def draw(game: Game, cell_size: int) -> Frame:
    """Draw the boards side by side, uint8 (height, width, 3), with their standings, and verdicts or keys."""
    boards = []
    for player in game.players:
        board = _board(player, cell_size, game.shows_optimum)
        names = np.array(player.evaluator.mdp.action_names)[player.evaluator.solution.optimal[player.state]]
        is_advised = game.shows_optimum and player.real is not None and not player.over
        advice = f"; optimal here: {' or '.join(names)}" if is_advised else ""
        board.caption(player.standing() + advice)
        is_person = player is game.person
        legend, again = (game.legend(), "; R: restart") if is_person else ("", "")
        board.footer(player.verdict() + again if player.over else legend)
        boards.append(board.frame())
    return np.concatenate(boards, axis=1)


def _board(player: Player, cell_size: int, with_optimum: bool) -> Sheet:
    mdp, real = player.evaluator.mdp, player.real
    if real is None:
        canvas = Canvas(mdp, cell_size, opaque=True)
        drawing.draw_world(canvas.world, mdp, player.state, cell_size)
        if with_optimum:
            draw_optimal_actions(canvas, player.evaluator.solution.optimal)
        return canvas
    frame = real.frame()
    larger = max(1, _LEAST_PICTURE // max(frame.shape))
    height, width = frame.shape[0] * larger, frame.shape[1] * larger
    sheet = Sheet((width + 2 * _BORDER, height + 2 * _BORDER), _BORDER, opaque=True)
    pixels = frame.repeat(larger, axis=0).repeat(larger, axis=1)
    picture = drawing.import_pygame().image.frombuffer(pixels, (width, height), "RGB")
    sheet.world.blit(picture, (_BORDER, _BORDER))
    return sheet


@limited()
def main(arguments: Sequence[str]) -> None:
    """Open the window and play until it is closed."""
    options = _parser().parse_intermixed_args(arguments)
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
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")  # environments initialise all of pygame
    pygame.display.init()
    window: Any = None
    clock, frames, is_printed, continues = pygame.time.Clock(), 0, False, True
    try:
        while continues:
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
                    continues = False
                elif event.type == pygame.KEYDOWN:
                    continues = game.press(pygame.key.name(event.key)) and continues
            frames += 1
            if frames % _TICKS == 0 and game.person.over:
                game.players[-1].act()
            if game.over and not is_printed:
                for player in game.players:
                    print(printable(f"{player.standing()}; {player.verdict()}"), flush=True)
            is_printed = game.over
    finally:
        pygame.quit()


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("play", __doc__, "--best", "--trust", "--config-dir", example="env=cliff env.slip=0.1")
    option = parser.add_argument
    option(
        "words",
        nargs="*",
        metavar="env=NAME",
        help="the world, as for train: env=cliff env.slip=0.1, recipe=...",
    )
    option("--layout", help="a shipped map's name or a map file (default classic)")
    for name, (kind, meaning) in _WORLD.items():
        option(f"--{name.replace('_', '-')}", type=kind, help=meaning)
    option("--gamma", type=float, help="discount of returns, 0 to 1 (default 0.99)")
    option("--seed", type=whole(0), default=0, help="seed of starts and slips (default 0)")
    option("--cell-size", type=whole(8), help="pixels of a map's cells (default 100, less on large maps)")
    option("--agent", type=Path, metavar="RUN", help="a finished run, whose agent plays next to you")
    return parser


def _game(options: argparse.Namespace) -> Game:
    """A game in the world of the options; with an agent, its run's settings are the defaults."""
    given = {name: getattr(options, name) for name in _WORLD if getattr(options, name) is not None}
    if options.agent is not None and (fixed := [*options.words, *given.keys() & {"num_rows", "num_cols"}]):
        raise InputError(f"{fixed[0]}: with --agent, the world has the size it was trained on")
    if runs := [word for word in options.words if os.sep in word.partition("=")[0] or Path(word).is_dir()]:
        raise InputError(f"{runs[0]}: is not a setting such as env=cliff; a run is given by --agent")
    words = [*options.words, *(f"--config-dir={each}" for each in options.config_dir)]
    refuse_unclear(words)
    saved = None if options.agent is None else SavedRun(options.agent, options.trust, options.best)
    config = saved.config if saved is not None else compose(words) if words else None
    env = MapConfig() if config is None else config.env
    if isinstance(env, MapConfig):
        env = dataclasses.replace(env, **given)
        if saved is not None:
            world = saved.evaluator(options.layout).mdp
            assert isinstance(world, GridMdp)
            mdp: Mdp = env.compile(world.layout)
        else:
            mdp = dataclasses.replace(env, layout=options.layout or env.layout).compile()
    elif wrong := [*given, *(["layout"] if options.layout is not None else [])]:
        raise InputError(f"--{wrong[0].replace('_', '-')}: {env.name} is not a map")
    else:
        mdp = env.compile() if saved is None else saved.mdp
    judged = EvaluationConfig() if config is None else config.evaluation
    evaluator = Evaluator(mdp, judged.gamma if options.gamma is None else options.gamma, env.step_limit(mdp))

    def real() -> RealEnv | None:
        if isinstance(env, GymnasiumConfig) and (saved is None or options.trust):
            return RealEnv(env, mdp)
        if not drawing.board_of(mdp).panels:
            trust = "; --trust lets its environment draw" if isinstance(env, GymnasiumConfig) else ""
            raise InputError(f"{mdp.name}: its states cannot be drawn{trust}")
        return None

    agent = None
    if saved is not None:
        policy = saved.snapshot().greedy_policy()
        agent = Player(evaluator, saved.config.agent.name, policy, evaluator.max_episode_steps, real())
    return Game(evaluator, options.seed, agent, real())
