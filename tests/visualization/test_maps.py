"""The maps of a run show what they say: every cell's colour, mark and legend, on worlds of any size."""

import logging
from pathlib import Path

import numpy as np
import pytest
from helpers.colours import check_words, opaque
from helpers.support import SHORT, train_in
from PIL import Image

from gridworld.agents.tabular.td_control import TabularConfig
from gridworld.config.train import TrainConfig
from gridworld.envs.rendering import AGENT, CLIFF, GOAL, TRAP, UNKNOWN, WALL, Frame
from gridworld.visualization.canvas import Canvas, greedy_paths
from gridworld.visualization.maps import (
    draw_error_map,
    draw_policy_map,
    draw_visit_map,
    explored,
    policy,
    value_error,
)
from gridworld.visualization.picture import PolicyHistory, Subject
from gridworld.visualization.sheet import BLUES, DISAGREES, ORANGES, VIRIDIS, Scale, counting, linear, short
from gridworld.world.evaluation import Evaluator, PolicySnapshot
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse
from gridworld.world.mdp import Mdp
from gridworld.world.solver import solved, value_iteration

CLASSIC = compile_mdp(load("classic"))
WORLDS = ["classic", "four_rooms", "maze", "cliff", "cliff_walking", "aima_4x3"]


def cell_pictures(mdp: Mdp, frame: Frame) -> dict[int, Frame]:
    """The part of the frame that is each cell's."""
    canvas = Canvas(mdp, legend_rows=2)
    left, top = canvas.world.get_offset()
    pictures = {}
    for state in range(mdp.num_states):
        x, y = (int(side) for side in canvas.point(state, 0, 0))
        pictures[state] = opaque(frame[top + y : top + y + canvas.cell, left + x : left + x + canvas.cell])
    return pictures


def has(picture: Frame, colour: tuple[int, ...]) -> bool:
    return bool((picture == colour).all(axis=2).any())


def playing(mdp: Mdp) -> np.ndarray:
    return np.flatnonzero(~(mdp.terminal | mdp.wall | mdp.cliff))


def test_scales_run_from_end_to_end_in_order_of_lightness() -> None:
    for ramp in (VIRIDIS, ORANGES, BLUES):
        lightness = ramp @ np.array([0.299, 0.587, 0.114])
        steps = np.diff(lightness) * np.sign(lightness[-1] - lightness[0])
        assert (steps >= 0).all()
        assert steps.sum() > 120
    values = np.array([-2.0, 0.0, 2.0, np.inf])
    assert np.array_equal(linear(VIRIDIS, values).colours(values), VIRIDIS[[0, 64, 127, 127]])
    above = np.array([1.0, 2.0])
    assert np.array_equal(linear(ORANGES, above, low=0).colours(above), ORANGES[[64, 127]])
    logarithmic = counting(BLUES, np.array([0, 1, 10, 100]))
    assert np.array_equal(logarithmic.colours(np.array([1.0, 10, 100])), BLUES[[0, 64, 127]])
    assert not counting(BLUES, np.array([0, 5, 99])).logarithmic
    assert counting(BLUES, np.zeros(3, dtype=int)).high == 0  # nobody has been anywhere


def test_short_numbers() -> None:
    whole = {873: "873", 0: "0", 1234: "1.2k", 9960: "10k", 23456: "23k", 999_600: "1.0M", 4_123_456: "4.1M"}
    assert {number: short(number) for number in whole} == whole
    scaled = {(-0.5, 1): "-0.50", (0.932, 1): "0.93", (0.004, 1): "0", (0.0123, 0.05): "0.012", (1, 1): "1"}
    scaled |= {(12.34, 50): "12.3", (123.4, 500): "123", (0.00012, 0.0004): "1e-4", (0.0, 0.0004): "0"}
    assert {pair: short(*pair) for pair in scaled} == scaled


@pytest.mark.parametrize("name", WORLDS)
def test_policy_map_colours_cells_by_value_and_frames_mistakes(name: str) -> None:
    mdp = compile_mdp(load(name))
    best = value_iteration(mdp, 0.99)
    greedy = np.argmax(best.optimal, axis=1)
    cells = cell_pictures(mdp, draw_policy_map(mdp, best.v, greedy, best.optimal, "all right").frame())
    assert not any(has(picture, DISAGREES) for picture in cells.values())

    wrong = int(mdp.start_states[0])
    greedy[wrong] = int(np.argmin(best.optimal[wrong]))
    cells = cell_pictures(mdp, draw_policy_map(mdp, best.v, greedy, best.optimal, "one wrong").frame())
    colours = linear(VIRIDIS, best.v[playing(mdp)]).colours(best.v)
    for state, picture in cells.items():
        corner = tuple(picture[len(picture) // 6, len(picture) // 6])
        if mdp.wall[state]:
            assert corner == WALL
        elif mdp.cliff[state]:
            assert np.array_equal(np.unique(picture[2:-2, 2:-2].reshape(-1, 3), axis=0), [CLIFF])  # no arrow
        elif not mdp.terminal[state]:
            assert corner == tuple(colours[state])
        assert has(picture, DISAGREES) == (state == wrong)
    assert has(cells[mdp.layout.state(mdp.layout.goals[0])], GOAL)


def test_policy_map_marks_start_and_path_and_greys_what_was_never_visited() -> None:
    best = value_iteration(CLASSIC, 0.99)
    greedy = np.argmax(best.optimal, axis=1)
    (path,) = greedy_paths(CLASSIC, greedy)
    assert path == [0, 1, 2, 3, 4, 5, 11, 17, 16]  # along the upper and the right border
    assert greedy_paths(compile_mdp(load("classic"), slip=0.2), greedy) == [path]  # where it does not slip
    visits = np.zeros((30, 4), dtype=int)
    visits[path[:-1], 0] = 1
    known = explored(CLASSIC, visits)
    assert np.flatnonzero(known).tolist() == path[:-1]
    values = np.where(known, best.v, 99.0)  # an initial value that nothing has corrected
    frame = draw_policy_map(CLASSIC, values, greedy, best.optimal, known=known).frame()
    for state, picture in cell_pictures(CLASSIC, frame).items():
        corner = tuple(picture[len(picture) // 8, len(picture) // 8])
        if state in playing(CLASSIC):
            assert has(picture, AGENT) == known[state]
            seen = linear(VIRIDIS, best.v[known]).colours(values)[state]
            assert corner == (tuple(seen) if known[state] else UNKNOWN)


def test_a_path_runs_below_arrows_into_the_goal_and_beside_numbers() -> None:
    best = value_iteration(CLASSIC, 0.99)
    greedy = np.argmax(best.optimal, axis=1)
    (path,) = greedy_paths(CLASSIC, greedy)
    cells = cell_pictures(CLASSIC, draw_policy_map(CLASSIC, best.v, greedy, best.optimal).frame())
    for state, picture in cells.items():
        side = len(picture)
        assert has(picture, AGENT) == (state in path)
        assert not has(picture[int(0.74 * side) :, int(0.56 * side) :], AGENT)  # where the number is
        if state in path[:-1]:
            assert tuple(picture[side // 2, side // 2]) in ((0, 0, 0), (255, 255, 255))
    goal = cells[path[-1]]
    assert has(goal[:, -len(goal) // 4 :], AGENT)  # up to the triangle
    assert not has(goal[:, : len(goal) // 2], AGENT)


def test_the_ground_is_transparent_and_its_words_can_be_read_on_light_and_dark_pages() -> None:
    best, visits = value_iteration(CLASSIC, 0.99), np.arange(120).reshape(30, 4)
    greedy = np.argmax(best.optimal, axis=1)
    two_lines = draw_policy_map(CLASSIC, best.v, greedy, best.optimal, "greedy\nestimates").frame()
    for frame in (two_lines, draw_error_map(CLASSIC, best.q, "error"), draw_visit_map(CLASSIC, visits, "at")):
        height, width, _ = frame.shape
        edges = (frame[0], frame[-1], frame[:, 0], frame[:, -1])
        assert not any(edge[:, 3].any() for edge in edges)
        inside = frame[height // 2, :, 3] == 255
        check_words(frame[: int(0.13 * height)])  # the caption
        check_words(frame[int(0.88 * height) :, inside.argmax() : inside.argmax() + width // 16])  # "value"
    still = draw_policy_map(CLASSIC, best.v, greedy, best.optimal, scale=Scale(VIRIDIS, 0, 1)).frame()
    assert still.shape[2] == 3  # of a film, which has no transparency
    assert (still[0] == 255).all()


def test_an_arrow_has_a_dark_and_a_light_part_on_every_colour() -> None:
    everything, greedy = np.ones((30, 4), dtype=bool), np.zeros(30, dtype=int)
    values = np.linspace(0, 1, 30)
    frame = draw_policy_map(CLASSIC, values, greedy, everything, scale=Scale(VIRIDIS, 0, 1)).frame()
    cells = cell_pictures(CLASSIC, frame)
    for state in playing(CLASSIC):
        lightness = cells[state][2:-2, 2:-2] @ np.array([0.299, 0.587, 0.114])
        assert lightness.min() < 30
        assert lightness.max() > 225


def test_colours_end_at_what_is_possible_and_the_caption_says_whose_numbers_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    captions: list[str] = []
    monkeypatch.setattr(Canvas, "caption", lambda _, text: captions.append(text))
    evaluator, visits = Evaluator(CLASSIC, 0.99, 100), np.ones((30, 4), dtype=int)
    values = solved(CLASSIC, 0.9).v.copy()
    values[[0, 5, 17]] = -2.5, 1.11, 1.0  # the most and the least that a policy can be worth: 1 and -1
    values[11] = -1.0
    snapshot = PolicySnapshot(np.zeros(30, dtype=int), np.full((30, 4), 0.25), values)
    config = TrainConfig(agent=TabularConfig(name="mine", gamma=0.9))
    frame = policy(Subject(config, True, evaluator, snapshot, 1234, visits))(None)
    assert isinstance(frame, np.ndarray)
    cells = cell_pictures(CLASSIC, frame)
    shown = {state: tuple(cells[state][30, 30]) for state in (0, 5, 11, 17)}
    low, high = tuple(VIRIDIS[0]), tuple(VIRIDIS[-1])
    assert shown == {0: low, 11: low, 5: high, 17: high}
    whose = "the agent's own estimates, discount 0.9; scores use 0.99"
    assert captions == [f"greedy policy after 1,234 steps\n{whose}"]


def test_paths_end_where_they_would_repeat_and_unreachable_cells_are_unknown() -> None:
    assert greedy_paths(CLASSIC, np.zeros(30, dtype=int)) == [[0, 0]]  # up, into the border
    cliff = compile_mdp(load("cliff_walking"))
    (path,) = greedy_paths(cliff, np.ones(cliff.num_states, dtype=int))  # right, off the cliff, to the start
    assert path[0] == path[-1] == cliff.start_states[0]
    split = compile_mdp(parse("S.G\n###\n...", "split"))
    for visits in (None, np.zeros((9, 4), dtype=int)):
        assert np.flatnonzero(explored(split, visits)).tolist() == [0, 1, 2]


def test_an_arrow_points_where_the_action_goes() -> None:
    values, everything = np.zeros(30), np.ones((30, 4), dtype=bool)
    for action, (rows, cols) in enumerate([(-1, 0), (0, 1), (1, 0), (0, -1)]):
        greedy = np.full(30, action)
        frame = draw_policy_map(CLASSIC, values, greedy, everything, scale=Scale(VIRIDIS, 0, 1)).frame()
        ink = (cell_pictures(CLASSIC, frame)[0] == 255).all(axis=2)
        down, right = (axis.mean() - len(ink) / 2 for axis in np.nonzero(ink))
        head = (down * rows + right * cols) / len(ink)
        assert head > 0.01  # there is more of an arrow at its head


@pytest.mark.parametrize("name", WORLDS)
def test_error_map_has_a_triangle_per_action(name: str) -> None:
    mdp = compile_mdp(load(name))
    best = value_iteration(mdp, 0.9)
    error = np.arange(mdp.num_states * 4, dtype=float).reshape(-1, 4)
    q = best.q + error * np.where(np.arange(4) % 2, 1, -1)
    snapshot = PolicySnapshot(q.argmax(axis=1), q, q.max(axis=1), q)
    assert value_error(snapshot, best) == pytest.approx(error)
    cells = cell_pictures(mdp, draw_error_map(mdp, error))
    colours = linear(ORANGES, error[playing(mdp)], low=0).colours(error)
    for state in playing(mdp):
        size = len(cells[state])
        near = size // 16 + 1  # to the edge, and not far from a corner: away from the numbers
        aside = near + 3
        points = [(near, aside), (aside, size - 1 - near), (size - 1 - near, aside), (aside, near)]
        for action, (row, col) in enumerate(points):
            assert tuple(cells[state][row, col]) == tuple(colours[state, action]), (state, action)


def test_error_of_an_agent_without_q_and_of_no_finite_optimum() -> None:
    mdp = compile_mdp(parse("S.G\n###\n..#", "split"), step_reward=-1)
    best = value_iteration(mdp, 1.0)
    assert np.isneginf(best.v[6])
    snapshot = PolicySnapshot(np.zeros(9, dtype=int), np.full((9, 4), 0.25), np.zeros(9))
    error = value_error(snapshot, best)
    assert error.shape == (9, 1)
    assert np.isnan(error[6, 0])
    assert error[0, 0] == pytest.approx(-best.v[0])
    cells = cell_pictures(mdp, draw_error_map(mdp, error))
    assert tuple(cells[6][5, 5]) == (255, 255, 255)
    assert tuple(cells[0][5, 5]) == tuple(ORANGES[-1])


def test_visit_map_colours_by_count_and_leaves_the_rest_white() -> None:
    visits = np.zeros((30, 4), dtype=int)
    visits[0], visits[1, 2], visits[2, 0] = [2000, 3000, 4000, 1000], 10, 317
    cells = cell_pictures(CLASSIC, draw_visit_map(CLASSIC, visits))
    assert [tuple(cells[state][5, 5]) for state in range(4)] == [
        *(tuple(BLUES[level]) for level in (127, 0, 64)),  # three decades
        (255, 255, 255),
    ]
    draw_visit_map(CLASSIC, np.zeros((30, 4), dtype=int))


@pytest.mark.parametrize("size", [(200, 200), (1, 4000), (4000, 1)], ids=str)
def test_large_worlds_are_colours_alone(size: tuple[int, int]) -> None:
    rows, cols = size
    tiles = ["." * cols for _ in range(rows)]
    tiles[0] = "S" + tiles[0][1:]
    tiles[-1] = tiles[-1][:-1] + "G"
    if rows > 1 < cols:
        tiles[5] = "T" + tiles[5][1:]
    mdp = compile_mdp(parse("\n".join(tiles), "large"))
    states = mdp.num_states
    values = np.arange(states) / states
    optimal = np.ones((states, 4), dtype=bool)
    optimal[states // 2] = False
    frame = draw_policy_map(mdp, values, np.zeros(states, dtype=int), optimal).frame()
    assert max(frame.shape) <= 3.5 * max(size)
    cells = cell_pictures(mdp, frame)
    goal = mdp.layout.state(mdp.layout.goals[0])
    assert has(cells[goal], GOAL)
    assert has(cells[states // 2], DISAGREES)
    assert mdp.trap.sum() == 0 or has(cells[5 * cols], TRAP)
    colours = linear(VIRIDIS, values[playing(mdp)]).colours(values)
    assert tuple(cells[states // 3][-1, -1]) == tuple(colours[states // 3])
    draw_error_map(mdp, np.tile(values[:, None], 4))
    draw_visit_map(mdp, np.ones((states, 4), dtype=int))


@pytest.mark.parametrize("evaluations", [1, 2, 47, 48, 49, 96, 97, 1000, 12_345])
def test_a_history_is_short_evenly_spread_and_ends_at_the_end(evaluations: int) -> None:
    history, large = PolicyHistory(30), PolicyHistory(512 * 512)
    for index in range(evaluations):
        snapshot = PolicySnapshot(np.zeros(30, int), np.empty((30, 4)), np.full(30, float(index)))
        history.add(100 * index, snapshot)
        large.add(index, PolicySnapshot(np.zeros(1, int), np.empty((1, 4)), np.zeros(1)))
    assert len(large.moments()) <= 20  # of a large world, it takes little memory
    steps = [moment.step for moment in history.moments()]
    assert (steps[0], steps[-1]) == (0, 100 * (evaluations - 1))
    assert min(evaluations, 24) <= len(steps) <= 49
    gaps = np.diff(steps)
    assert len(set(gaps[:-1])) <= 1  # the last one may be shorter
    assert all(gap <= gaps[0] for gap in gaps)
    assert all((moment.values == moment.step // 100).all() for moment in history.moments())


def test_a_run_leaves_out_what_cannot_be_drawn_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "wide.txt").write_text("S.G" + "#" * 65_600)
    own = (f"env.layout={tmp_path / 'wide.txt'}", "total_timesteps=320", "env.max_episode_steps=5")
    with caplog.at_level(logging.WARNING):
        train_in(tmp_path / "endless", *SHORT["q_learning"], "env.step_reward=0.1", "agent.gamma=1")
        assert "q_error.png is left out, gamma=1 in " in caplog.text
        caplog.clear()
        train_in(tmp_path / "wide", *SHORT["q_learning"], *own)
    for name in ("policy.png", "q_error.png", "visits.png", "learning.gif", "the episode"):
        assert caplog.text.count(f"{name} is left out") == 1
        assert "65605 x 3 pixels is too large to draw" in caplog.text
    assert not (tmp_path / "endless" / "q_error.png").exists()
    assert (tmp_path / "endless" / "visits.png").exists()
    assert (tmp_path / "wide" / "visits.npy").exists()


def test_pictures_can_be_switched_off_and_the_learning_gif_lasts_as_long_as_its_evaluations(
    tmp_path: Path,
) -> None:
    names = ("policy_map", "q_error", "visits", "frames", "gif")
    settings = [*(f"recording.{name}=false" for name in names), "recording.fps=5", "recording.cell_size=50"]
    train_in(tmp_path, *SHORT["q_learning"], *settings)
    assert [path.name for path in tmp_path.iterdir() if path.suffix in (".png", ".gif")] == ["learning.gif"]
    total = 0
    with Image.open(tmp_path / "learning.gif") as film:
        assert film.width == 50 * (6 + 2)
        for index in range(film.n_frames):
            film.seek(index)
            total += film.info["duration"]
    assert total == 200 * (5 + 4)  # five evaluations, and the last one rests
