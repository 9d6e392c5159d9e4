"""The game that a person plays with the arrow keys, perhaps beside a trained agent, without its window.

`Game` is a state machine driven by key presses and ticks; `draw` is a function of it. The agent takes a step
whenever the person does, and continues alone when the person's episode is over.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from gridworld.envs import rendering as drawing
from gridworld.envs.env import GridWorldEnv
from gridworld.envs.rendering import Frame
from gridworld.storage.serialization import independent_generator
from gridworld.visualization.canvas import Canvas
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import FloatArray

_SAME = 1e-9  # returns that differ by rounding alone


class Key(Enum):
    """The meaning of a key; the values of the first four are the actions' numbers."""

    UP = 0
    RIGHT = 1
    DOWN = 2
    LEFT = 3
    RESTART = 4
    QUIT = 5


class Player:
    """An episode in progress, of at most `limit` steps, and its return so far."""

    def __init__(self, evaluator: Evaluator, name: str, limit: int | None = None) -> None:
        self.evaluator, self.name, self._limit = evaluator, name, limit
        self._env = GridWorldEnv(mdp=evaluator.mdp)
        self.state = self.steps = 0
        self.value = self.optimum = 0.0  # discounted return so far, and the best expected from the start
        self.over = False

    def restart(self, seed: int) -> None:
        """Start an episode; players with the same seed start in the same cell."""
        self.state, _ = self._env.reset(seed=seed)
        self.steps, self.value, self.over = 0, 0.0, False
        self.optimum = float(self.evaluator.solution.v[self.state])

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
    """A person's board and perhaps an agent's.

    Args:
        evaluator: of the world.
        seed: of the start and the slips; a restart adds 1.
        policy: the agent's, (S, A); None: there is no agent.
        agent: the agent's name.
        limit: the most steps of an agent's episode.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        seed: int = 0,
        policy: FloatArray | None = None,
        agent: str = "agent",
        limit: int | None = None,
    ) -> None:
        self.quit = False
        self.person = Player(evaluator, "you")
        self.agent = None if policy is None else Player(evaluator, agent, limit)
        self.players = [self.person] if self.agent is None else [self.person, self.agent]
        self._policy, self._seed = policy, seed
        self._restart()

    @property
    def over(self) -> bool:
        """Whether all episodes are over."""
        return all(player.over for player in self.players)

    def press(self, key: Key) -> None:
        """Handle a key that the person pressed."""
        if key is Key.QUIT:
            self.quit = True
        elif key is Key.RESTART:
            self._seed += 1
            self._restart()
        elif not self.person.over:
            self.person.step(key.value)
            self._agent_steps()

    def tick(self) -> None:
        """Let the agent take a step if the person's episode is over."""
        if self.person.over:
            self._agent_steps()

    def _agent_steps(self) -> None:
        if self.agent is not None and self._policy is not None:
            row = self._policy[self.agent.state]
            self.agent.step(int(self._chance.choice(len(row), p=row)))

    def _restart(self) -> None:
        self._chance = independent_generator(self._seed)  # the world uses the seed's own generator
        for player in self.players:
            player.restart(self._seed)


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
