"""Playing by hand: what the keys do, what the boards show, and a window that obeys."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pygame
import pytest
from helpers.support import ROOT, SHORT, train_in

from gridworld.commands import play as command
from gridworld.commands.play import Game, Key, draw
from gridworld.envs.rendering import AGENT, draw_frame
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse

CLASSIC = Evaluator(compile_mdp(load("classic")), 0.99, 100)
UP, RIGHT, DOWN, LEFT = Key.UP, Key.RIGHT, Key.DOWN, Key.LEFT
SHORTEST = [*[RIGHT] * 5, DOWN, DOWN, LEFT]


def pressed(game: Game, *keys: Key) -> Game:
    for key in keys:
        game.press(key)
    return game


def test_keys_are_the_actions_and_returns_are_discounted() -> None:
    game = pressed(Game(CLASSIC), RIGHT, DOWN, LEFT, UP, UP)
    assert (game.person.state, game.person.steps, game.person.value, game.over) == (0, 5, 0, False)
    assert game.person.standing() == "you: 5 steps, return 0, optimum 0.9321"
    game = pressed(Game(CLASSIC), *SHORTEST)
    assert game.over
    assert game.person.value == pytest.approx(0.99**7)
    assert game.person.verdict() == "goal after 8 steps: nobody could do better"
    pressed(game, UP, RIGHT)
    assert game.person.steps == 8  # it is over
    game = pressed(Game(CLASSIC), UP, *SHORTEST)
    assert game.person.verdict() == "goal after 9 steps: 0.009321 less than the optimum"
    game = pressed(Game(CLASSIC), *[RIGHT] * 4, DOWN)
    assert game.person.verdict().startswith("trap after 5 steps: 1.893 less than the optimum")
    pressed(game, Key.RESTART)
    assert (game.person.state, game.person.steps, game.person.value, game.over) == (0, 0, 0, False)
    assert not game.quit
    assert pressed(game, Key.QUIT).quit


def test_the_agent_keeps_step_and_walks_on_alone() -> None:
    game = Game(CLASSIC, 0, CLASSIC.optimal_policy(), "dqn", limit=100)
    assert game.agent is not None
    game.tick()
    assert game.agent.steps == 0  # it waits for the person
    pressed(game, DOWN)
    assert game.agent.steps == 1
    pressed(game, UP, *[RIGHT] * 4, DOWN)
    assert game.person.over
    assert (game.agent.steps, game.over) == (7, False)
    game.tick()
    assert game.over
    assert game.agent.verdict() == "goal after 8 steps: nobody could do better"
    game.tick()
    assert game.agent.steps == 8


def test_an_agent_that_finds_no_end_gives_up() -> None:
    still = np.zeros((30, 4))
    still[:, 0] = 1.0
    game = pressed(Game(CLASSIC, 0, still, "dqn", limit=20), *SHORTEST)
    for _ in range(30):
        game.tick()
    assert game.over
    assert game.agent is not None
    assert game.agent.verdict() == "no end after 20 steps: 0.9321 less than the optimum"


def test_in_a_slippery_world_the_optimum_is_a_mean() -> None:
    evaluator = Evaluator(compile_mdp(parse("S.G\nTTT", "edge"), slip=0.2), 0.9, 100)
    verdicts = set()
    for seed in range(30):
        game = Game(evaluator, seed)
        while not game.over:
            game.press(RIGHT)
        verdicts.add(game.person.verdict())
        assert game.person.optimum == evaluator.optimal_value
    assert any("more than the best policy gets on average" in verdict for verdict in verdicts)
    assert any("less than the best policy gets on average" in verdict for verdict in verdicts)


def test_both_begin_in_the_same_cell_and_each_game_in_its_own() -> None:
    evaluator = Evaluator(compile_mdp(parse("SSSS\nSSSS\n...G", "many")), 0.9, 100)
    game = Game(evaluator, 0, evaluator.optimal_policy())
    begun = []
    for _ in range(12):
        assert game.agent is not None
        assert game.person.state == game.agent.state
        assert game.person.optimum == pytest.approx(evaluator.solution.v[game.person.state])
        begun.append(game.person.state)
        game.press(Key.RESTART)
    assert len(set(begun)) > 2


def test_the_boards_are_the_environments_own_frames() -> None:
    game = pressed(Game(CLASSIC, 0, CLASSIC.optimal_policy()), DOWN, RIGHT)
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
        "you: 8 steps, return 0.9321, optimum 0.9321; goal after 8 steps: nobody could do better\n"
    )
    agent = [(frame == AGENT).all(axis=2) for frame in shown]
    assert np.array_equal(agent[0], agent[-1])  # back at the start
    assert len({mask.tobytes() for mask in agent}) == 9  # a picture per cell on the way
    assert not pygame.display.get_init()


def test_a_trained_agent_plays_beside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    train_in(tmp_path, *SHORT["dqn"], "env.slip=0.1", "env.max_episode_steps=8")
    capsys.readouterr()
    keys = iter([pygame.K_DOWN] * 8 + [pygame.K_r] + [pygame.K_q])

    def get() -> list[pygame.event.Event]:
        assert pygame.display.get_surface().get_size() == (2 * 8 * 40, 7 * 40)
        return [pygame.event.Event(pygame.KEYDOWN, key=next(keys))]

    monkeypatch.setattr(pygame.event, "get", get)
    command.main(["--agent", str(tmp_path), "--cell-size", "40", "--gamma", "0.9"])
    assert next(keys, None) is None


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="Xvfb is not installed")
def test_a_real_window_opens(tmp_path: Path) -> None:
    """On an X server of its own; the event that closes the window comes from outside the loop."""
    code = (
        "import sys, threading, time, pygame\n"
        "def close():\n"
        "    while not pygame.display.get_surface(): time.sleep(0.05)\n"
        "    print(pygame.display.get_driver())\n"
        "    pygame.event.post(pygame.event.Event(pygame.QUIT))\n"
        "threading.Thread(target=close, daemon=True).start()\n"
        "from gridworld.commands.play import main\n"
        "main(['--cell-size', '30'])\n"
    )
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "800x600x24"],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    try:
        os.close(write)
        display = os.read(read, 16).decode().strip()
        environment = {**os.environ, "DISPLAY": f":{display}", "PYTHONPATH": str(ROOT)}
        del environment["SDL_VIDEODRIVER"]
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60
        )
    finally:
        os.close(read)
        server.terminate()
        server.wait()
    assert (done.returncode, done.stdout) == (0, "x11\n"), done.stderr
