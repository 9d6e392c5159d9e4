"""Playing by hand: what the keys do, what the boards show, and a window that obeys."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pygame
import pytest
from helpers.support import SHORT, train_in

from gridworld.base.errors import InputError
from gridworld.commands import play as command
from gridworld.commands.play import Game, Player, draw
from gridworld.config.worlds import EnumeratedConfig, GymnasiumConfig
from gridworld.envs.rendering import AGENT, draw_frame
from gridworld.visualization.episode import RealEnv
from gridworld.visualization.sheet import Sheet
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse

CLASSIC = Evaluator(compile_mdp(load("classic")), 0.99, 100)
UP, RIGHT, DOWN, LEFT = range(4)
SHORTEST = [*[RIGHT] * 5, DOWN, DOWN, LEFT]


def moved(game: Game, *actions: int) -> Game:
    for action in actions:
        game.move(action)
    return game


def test_keys_are_the_actions_and_returns_are_discounted() -> None:
    game = moved(Game(CLASSIC), RIGHT, DOWN, LEFT, UP, UP)
    assert (game.person.state, game.person.steps, game.person.value, game.over) == (0, 5, 0, False)
    assert game.person.standing() == "you: 5 steps, return 0, discounted 0, optimum 0.9321"
    game = moved(Game(CLASSIC), *SHORTEST)
    assert game.over
    assert (game.person.total, game.person.value) == (1, pytest.approx(0.99**7))
    assert game.person.standing() == "you: 8 steps, return 1, discounted 0.9321, optimum 0.9321"
    moved(game, UP, RIGHT)  # it is over
    assert game.person.verdict() == "goal after 8 steps: nobody could do better"
    game = moved(Game(CLASSIC), UP, *SHORTEST)
    assert game.person.verdict() == "goal after 9 steps: 0.009321 less than the optimum"
    game = moved(Game(CLASSIC), *[RIGHT] * 4, DOWN)
    assert game.person.verdict().startswith("trap after 5 steps: 1.893 less than the optimum")
    game.restart()
    assert (game.person.state, game.person.steps, game.person.value, game.over) == (0, 0, 0, False)


def test_an_episode_that_is_over_says_how_to_start_another(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    monkeypatch.setattr(Sheet, "footer", lambda sheet, text: written.append(text))
    agent = Player(CLASSIC, "dqn", CLASSIC.optimal_policy(), 100)
    draw(moved(Game(CLASSIC, 0, agent), *SHORTEST), 60)
    verdict = "goal after 8 steps: nobody could do better"
    assert written == [f"{verdict}; R: restart", verdict]


def test_the_agent_keeps_step_and_walks_on_alone_until_it_gives_up() -> None:
    agent = Player(CLASSIC, "dqn", CLASSIC.optimal_policy(), 100)
    game = Game(CLASSIC, 0, agent)
    moved(game, DOWN, UP, *[RIGHT] * 4, DOWN)
    assert game.person.over
    assert (agent.steps, game.over) == (7, False)
    agent.act()
    assert game.over
    agent.act()
    assert agent.verdict() == "goal after 8 steps: nobody could do better"
    still = Player(CLASSIC, "dqn", np.eye(4)[np.zeros(30, dtype=int)], 20)
    game = moved(Game(CLASSIC, 0, still), *SHORTEST)
    for _ in range(30):
        still.act()
    assert game.over
    assert still.verdict() == "no end after 20 steps: 0.9321 less than the optimum"


def test_in_a_slippery_world_the_optimum_is_a_mean() -> None:
    evaluator = Evaluator(compile_mdp(parse("S.G\nTTT", "edge"), slip=0.2), 0.9, 100)
    verdicts = ""
    for seed in range(30):
        game = Game(evaluator, seed)
        while not game.over:
            game.move(RIGHT)
        verdicts += game.person.verdict()
        assert game.person.optimum == evaluator.optimal_value
    assert "more than the best policy gets on average" in verdicts
    assert "less than the best policy gets on average" in verdicts


def test_both_begin_in_the_same_cell_and_each_game_in_its_own() -> None:
    evaluator = Evaluator(compile_mdp(parse("SSSS\nSSSS\n...G", "many")), 0.9, 100)
    agent = Player(evaluator, "dqn", evaluator.optimal_policy())
    game = Game(evaluator, 0, agent)
    begun = []
    for _ in range(12):
        assert game.person.state == agent.state
        assert game.person.optimum == pytest.approx(evaluator.solution.v[game.person.state])
        begun.append(game.person.state)
        game.restart()
    assert len(set(begun)) > 2


def test_o_shows_every_optimal_action_over_the_map_and_hides_it_again() -> None:
    game = Game(CLASSIC)
    plain = draw(game, 60)
    assert game.press("o")
    shown = draw(game, 60)
    arrows = (shown != plain).any(axis=2)
    for state in (0, 6, 11):  # the start, the cell below it, and the last one of the second row
        row, col = divmod(state, 6)
        cell = arrows[(row + 1) * 60 : (row + 2) * 60, (col + 1) * 60 : (col + 2) * 60]
        sides = {UP: cell[2:20], RIGHT: cell[:, 42:58], DOWN: cell[42:58], LEFT: cell[:, 2:20]}
        optimal = np.flatnonzero(CLASSIC.solution.optimal[state]).tolist()
        assert [side for side, part in sides.items() if part.any()] == optimal
    game.press("o")
    assert np.array_equal(draw(game, 60), plain)


@pytest.mark.parametrize("real", [True, False])
def test_taxi_is_played_with_arrows_and_digits(real: bool) -> None:
    env = GymnasiumConfig(id="Taxi-v4")
    mdp = env.compile()
    evaluator = Evaluator(mdp, 0.99, env.step_limit(mdp))
    game = Game(evaluator, 0, real=RealEnv(env, mdp) if real else None)
    assert game.legend() == (
        "arrow keys: move, 1: pickup, 2: dropoff, O: optimal policy, R: restart, Q: quit"
    )
    assert game.keys == {"down": 0, "up": 1, "right": 2, "left": 3, "1": 4, "2": 5}
    first, keys = draw(game, 20), {action: key for key, action in game.keys.items()}
    game.press("o")
    while not game.over:
        action = int(evaluator.solution.optimal[game.person.state].argmax())
        before = draw(game, 20)
        game.press(keys[action])
        assert not np.array_equal(draw(game, 20), before)
    assert game.person.verdict().endswith("nobody could do better")
    assert first.shape == before.shape


@pytest.mark.slow
def test_minigrid_is_played_in_its_own_pictures_and_its_time_is_limited() -> None:
    env = EnumeratedConfig(id="MiniGrid-Empty-5x5-v0", kwargs={"max_steps": 7})
    mdp = env.compile()
    evaluator = Evaluator(mdp, 0.99, env.step_limit(mdp))
    game = Game(evaluator, 0, real=RealEnv(env, mdp))
    assert game.legend().startswith("arrow keys: move, 1: pickup, 2: drop, 3: toggle, 4: done, O")
    for _ in range(2):
        for key in ("up", "up", "right", "up", "up"):
            game.press(key)
        assert game.person.verdict() == "goal after 5 steps: nobody could do better"
        game.press("r")
    turned = [draw(game, 20)]
    for _ in range(7):
        game.press("left")
        turned.append(draw(game, 20))
    assert game.person.verdict().startswith("no end after 7 steps")
    assert all((one != other).any() for one, other in pairwise(turned))


def test_a_world_that_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    tables = {"next_state": [[0, 1], [0, 1]], "reward": [[0.0, 0.0], [0.0, 1.0]]}
    ends = {"terminated": [[False, False], [False, True]], "start": [1.0, 0.0]}
    np.savez(tmp_path / "rooms.npz", **tables, **ends)
    with pytest.raises(InputError, match="rooms: its states cannot be drawn"):
        command.main(["env=arrays", f"env.path={tmp_path / 'rooms.npz'}"])


def test_the_boards_are_the_environments_own_frames() -> None:
    game = moved(Game(CLASSIC, 0, Player(CLASSIC, "dqn", CLASSIC.optimal_policy())), DOWN, RIGHT)
    picture = draw(game, 60)
    assert picture.shape == (7 * 60, 2 * 8 * 60, 3)
    grid = (slice(60, 6 * 60 + 1), slice(60, 7 * 60 + 1))  # without the border, where the words are
    for board, state in enumerate((7, 2)):
        part = picture[:, board * 480 : (board + 1) * 480]
        assert np.array_equal(part[grid], draw_frame(CLASSIC.mdp, state, 60)[grid])
    assert not (picture[:60] == 255).all()
    assert not (picture[6 * 60 + 1 :] == 255).all()


def test_the_window_obeys_the_keyboard(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [*["right"] * 5, "down", "x", "down", "left", None, "r", "up", "escape"]
    shown = []

    def get() -> list[pygame.event.Event]:
        window = pygame.display.get_surface()
        shown.append(pygame.surfarray.array3d(window).swapaxes(0, 1))
        name = names.pop(0)
        return [] if name is None else [pygame.event.Event(pygame.KEYDOWN, key=pygame.key.key_code(name))]

    monkeypatch.setattr(pygame.event, "get", get)
    command.main(["--cell-size", "30"])
    assert not names
    assert capsys.readouterr().out == (
        "you: 8 steps, return 1, discounted 0.9321, optimum 0.9321; "
        "goal after 8 steps: nobody could do better\n"
    )
    agent = [(frame == AGENT).all(axis=2) for frame in shown]
    assert np.array_equal(agent[0], agent[-1])  # back at the start
    assert len({mask.tobytes() for mask in agent}) == 9  # a picture per cell on the way
    assert not pygame.display.get_init()


def test_a_trained_agent_plays_beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train_in(tmp_path, *SHORT["sarsa"], "env.slip=0.1", "env.max_episode_steps=8", "recording.gif=false")
    keys = iter([pygame.K_DOWN] * 8 + [pygame.K_r])

    def get() -> list[pygame.event.Event]:
        assert pygame.display.get_surface().get_size() == (2 * 8 * 40, 7 * 40)
        pressed = next(keys, None)
        if pressed is None:  # the window is closed
            return [pygame.event.Event(pygame.QUIT)]
        return [pygame.event.Event(pygame.KEYDOWN, key=pressed)]

    monkeypatch.setattr(pygame.event, "get", get)
    command.main(["--agent", str(tmp_path), "--cell-size", "40", "--gamma", "0.9"])
    assert next(keys, None) is None
