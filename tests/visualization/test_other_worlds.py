"""Pictures of worlds that are no maps: panels, other actions, states without a place, foreign frames."""

import dataclasses
import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from helpers.colours import check_words, opaque
from numpy.typing import NDArray

from gridworld.base.errors import InputError
from gridworld.config.train import PICTURES, TrainConfig
from gridworld.config.worlds import EnvConfig, GymnasiumConfig
from gridworld.envs.rendering import (
    AGENT,
    GOAL,
    TRAP,
    UNKNOWN,
    Frame,
    Kind,
    Panel,
    ansi,
    board_of,
    draw_frame,
    fitting_cell_size,
)
from gridworld.envs.rollout import Episode, play
from gridworld.visualization import episode
from gridworld.visualization.animation import Animation, animation_of_rendered
from gridworld.visualization.canvas import Canvas, directions, moving_actions
from gridworld.visualization.episode import film, rendered_frames
from gridworld.visualization.files import save
from gridworld.visualization.maps import draw_error_map, draw_policy_map, policy, visits
from gridworld.visualization.picture import PolicyHistory, Subject, drawer
from gridworld.visualization.sheet import BLUES, DISAGREES, ORANGES, linear
from gridworld.visualization.state_table import StateTable, table_states
from gridworld.world.evaluation import Evaluator, PolicySnapshot
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load
from gridworld.world.mdp import IntArray, Mdp
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes
from gridworld.world.solver import value_iteration
from gridworld.world.sources.environment import compile_id

DIRECTIONS = {"up": (-1, 0), "right": (0, 1), "down": (1, 0), "left": (0, -1)}
DIRECTIONS |= {"north": (-1, 0), "east": (0, 1), "south": (1, 0), "west": (0, -1)}
FROZEN_LAKE, CLIFF_WALKING, TAXI = (
    GymnasiumConfig(id=name).compile() for name in ("FrozenLake-v1", "CliffWalking-v1", "Taxi-v4")
)


def certain(name: str, next_state: IntArray, end: int, reward: float = 0.0, **settings: Any) -> Mdp:
    """A world without chance, by the states (S, A) that actions lead to; entering the end is worth 1."""
    targets = next_state[..., None]
    rewards, start = np.where(targets == end, 1.0, reward), np.eye(len(next_state))[0]
    tables = {"next_state": targets, "probability": np.ones(targets.shape), "reward": rewards}
    outcomes = Outcomes(**tables, terminated=targets == end, start=start)
    return mdp_from_outcomes(name, outcomes, **settings)


def chain(length: int) -> Mdp:
    """Action 0 leads back to the start, action 1 to the next state, the last of which is the end."""
    next_state = np.stack([np.zeros(length, dtype=int), np.arange(1, length + 1)], axis=1)
    next_state = np.append(next_state, [[length, length]], axis=0)
    return certain("chain", next_state, length, -0.5, action_names=["back", "on"])


def deep_sea(size: int, mirrored: bool) -> Mdp:
    """Each step goes down, and left or right; `mirrored`: actions are swapped in every other row."""
    cells = size * size
    rows, cols = np.divmod(np.arange(cells), size)
    right = (np.arange(2) == 1) != ((rows % 2 == 1) & mirrored)[:, None]
    beside = np.clip(np.where(right, cols[:, None] + 1, cols[:, None] - 1), 0, size - 1)
    next_state = np.where(rows[:, None] == size - 1, cells, (rows[:, None] + 1) * size + beside)
    places = np.array([*((0, *divmod(cell, size)) for cell in range(cells)), (-1, -1, -1)])
    return certain("deep sea", np.append(next_state, [[cells, cells]], axis=0), cells, places=places)


def subject(mdp: Mdp, q: NDArray[np.float64], visits: NDArray[np.int64]) -> Subject:
    snapshot = PolicySnapshot(q.argmax(axis=1), np.full(q.shape, 1 / q.shape[1]), q.max(axis=1), q)
    history = PolicyHistory(mdp.num_states)
    for step in range(3):
        history.add(step, snapshot)
    return Subject(TrainConfig(), True, Evaluator(mdp, 0.95, 50), snapshot, 3, visits, history)


def cell_of(mdp: Mdp, frame: Frame, state: int, legend_rows: int = 1) -> Frame:
    canvas = Canvas(mdp, legend_rows=legend_rows)
    left, top = np.add(canvas.world.get_offset(), canvas.point(state, 0, 0)).astype(int)
    return opaque(frame[top : top + canvas.cell, left : left + canvas.cell])


def has(picture: Frame, colour: tuple[int, ...]) -> bool:
    return bool((picture == colour).all(axis=2).any())


def test_panels_stand_in_a_mosaic_near_to_square_with_a_blank_line_between_two() -> None:
    board = board_of(TAXI)
    assert board is board_of(TAXI)
    assert (board.rows, board.cols, len(board.panels)) == (29, 23, 20)
    assert board.panels[5] == Panel(top=6, left=6, rows=5, cols=5, name="G to G")
    assert (board.kind[5] == Kind.BLANK).all()
    assert (board.kind[:, 5] == Kind.BLANK).all()
    assert (board.kind == Kind.GOAL).sum() == 4
    assert (board.kind == Kind.UNREACHABLE).sum() == 4 * 24  # brought there without having been fetched
    assert board_of(TAXI).floor.sum() == 400
    assert len(board_of(CLIFF_WALKING).panels) == 1


def test_of_two_states_in_a_place_the_first_that_can_be_reached_is_shown() -> None:
    places = np.array([(0, 0, 0), (0, 0, 1), (0, 0, 1), (0, 0, 2)])
    mdp = certain("crowd", np.array([2, 2, 3, 3])[:, None], 3, places=places)
    assert board_of(mdp).state.tolist() == [[0, 2, 3]]
    assert ansi(mdp, 2) == "SAG\n"


def test_a_world_from_outcomes_looks_as_the_same_map_does() -> None:
    same = compile_mdp(load("frozen_lake_4x4"))
    assert ansi(FROZEN_LAKE, 5) == ansi(same, 5)
    assert np.array_equal(draw_frame(FROZEN_LAKE, 1, 20), draw_frame(same, 1, 20))
    cliff = draw_frame(CLIFF_WALKING, 36, 10)
    assert tuple(cliff[45, 25]) == UNKNOWN  # nobody ever is on the cliff


def test_an_action_that_slips_falls_or_bumps_has_one_arrow_everywhere() -> None:
    for mdp in (FROZEN_LAKE, CLIFF_WALKING, TAXI):
        for action, name in enumerate(mdp.action_names):
            ways = np.unique(directions(mdp)[:, action], axis=0).tolist()
            assert ways == [list(DIRECTIONS.get(name, (0, 0)))]
    assert moving_actions(FROZEN_LAKE) == (3, 2, 1, 0)
    assert moving_actions(CLIFF_WALKING) == (0, 1, 2, 3)
    assert moving_actions(TAXI) is None
    assert moving_actions(compile_mdp(load("cliff"), slip=1.0)) == (0, 1, 2, 3)


def test_arrows_may_be_diagonal_and_differ_from_state_to_state() -> None:
    plain, mirrored = (directions(deep_sea(6, swap)) for swap in (False, True))
    assert plain[8].tolist() == [[1, -1], [1, 1]]
    assert mirrored[[0, 7, 14], 1].tolist() == [[1, 1], [1, -1], [1, 1]]


def test_error_triangles_lie_on_the_side_that_the_action_moves_to() -> None:
    error = np.zeros((16, 4))
    error[6] = [1, 2, 3, 4]  # left, down, right, up
    cell = cell_of(FROZEN_LAKE, draw_error_map(FROZEN_LAKE, error), 6)
    low, far = 4, len(cell) - 5
    points = [(9, low), (far, 9), (9, far), (low, 9)]
    colours = linear(ORANGES, error, low=0).colours(error[6])
    assert [tuple(cell[point]) for point in points] == [tuple(colour) for colour in colours]


def test_with_other_actions_a_cell_has_the_largest_error_and_what_cannot_be_reached_is_grey() -> None:
    error = np.zeros((TAXI.num_states, 6))
    error[1, 4], error[2, 0] = 3.0, 6.0
    frame = draw_error_map(TAXI, error)
    assert tuple(cell_of(TAXI, frame, 1)[4, 4]) == tuple(ORANGES[64])
    assert tuple(cell_of(TAXI, frame, 2)[4, 4]) == tuple(ORANGES[127])
    assert tuple(cell_of(TAXI, frame, 20)[4, 4]) == UNKNOWN
    assert has(cell_of(TAXI, frame, 0), GOAL)


def test_the_policy_of_a_mosaic_has_dots_where_no_action_moves_and_diagonal_paths() -> None:
    best = value_iteration(TAXI, 0.95)
    frame = draw_policy_map(TAXI, best.v, best.optimal.argmax(axis=1), best.optimal).frame()
    cells = [cell_of(TAXI, frame, state, 2) for state in np.flatnonzero(board_of(TAXI).floor)]
    canvas = Canvas(TAXI, legend_rows=2)
    top, left = canvas.world.get_offset()[1], canvas.cell
    check_words(frame[top : top + canvas.cell, left:])  # the names of the upper panels
    assert not frame[top + 7 * canvas.cell - 4, :, 3].any()  # between two rows of panels
    assert not any(has(cell, DISAGREES) for cell in cells)
    sea = deep_sea(5, mirrored=False)
    frame = draw_policy_map(sea, np.zeros(26), np.ones(26, dtype=int), np.ones((26, 2), dtype=bool)).frame()
    assert [has(cell_of(sea, frame, 6 * row, 2), AGENT) for row in range(5)] == [True] * 5
    assert not has(cell_of(sea, frame, 5, 2)[20:-20, 20:-20], AGENT)


def test_a_table_has_the_most_visited_states_in_the_order_in_which_they_are_met() -> None:
    visits = np.ones((41, 2), dtype=np.int64)
    visits[[3, 30]] = 100
    assert table_states(chain(40)).tolist() == list(range(24))
    assert table_states(chain(40), visits).tolist() == [*range(23), 30]
    assert table_states(chain(5)).tolist() == [0, 1, 2, 3, 4]


def table_cell(table: StateTable, frame: Frame, row: int, column: int) -> Frame:
    left, top, width, height = table.box(row, column)
    x, y = table.world.get_offset()
    return opaque(frame[y + top : y + top + height, x + left : x + left + width])


@pytest.mark.parametrize("has_q", [True, False])
def test_a_policy_table_frames_the_greedy_action(has_q: bool) -> None:
    world = chain(5)
    q = value_iteration(world, 0.95).q.copy()
    q[2] = q[2, ::-1]
    visited = np.repeat(np.arange(6) < 4, 2).reshape(6, 2)
    of_it = subject(world, q, visited.astype(np.int64))
    if not has_q:
        of_it = dataclasses.replace(of_it, snapshot=dataclasses.replace(of_it.snapshot, q=None))
    frame = policy(of_it)(None)
    table = StateTable(world, table_states(world), world.action_names, legend_rows=2)
    check_words(frame[: table.world.get_offset()[1] + table.box(0, 0)[1]])
    check_words(frame[:, : table.world.get_offset()[0] + table.box(0, 0)[0]][:180])
    for row in range(5):
        cells = [table_cell(table, frame, row, column) for column in range(2)]
        assert [has(cell, AGENT) for cell in cells] == [False, row != 2]
        assert [has(cell, DISAGREES) for cell in cells] == [row == 2, False]
        assert has(cells[0], UNKNOWN) == (row == 4)


def test_a_visit_table_leaves_actions_never_taken_white() -> None:
    world, white = chain(3), (255, 255, 255)
    counts = np.array([[1, 50], [0, 25], [0, 0], [0, 0]])
    frame = visits(subject(world, np.zeros((4, 2)), counts))(None)
    table = StateTable(world, table_states(world), world.action_names)
    corners = [tuple(table_cell(table, frame, row, col)[3, 3]) for row in range(3) for col in range(2)]
    assert corners[:3] == [tuple(BLUES[0]), tuple(BLUES[127]), white]
    assert corners[4:] == [white, white] != corners[3:4] * 2


@pytest.mark.parametrize(
    "world",
    [FROZEN_LAKE, CLIFF_WALKING, TAXI, deep_sea(4, True), chain(40), dataclasses.replace(TAXI, places=None)],
    ids=["frozen", "cliff", "taxi", "sea", "chain", "taxi without places"],
)
def test_every_picture_can_be_drawn_of_any_world(world: Mdp, tmp_path: Path) -> None:
    shape = (world.num_states, world.num_actions)
    rng = np.random.default_rng(0)
    of_it = subject(world, rng.normal(size=shape), rng.integers(0, 9, shape))
    for picture in PICTURES.values():
        if picture.file.endswith((".png", ".gif")):
            prepared = drawer(picture.drawer)(of_it)
            drawn = prepared(None)
            if picture.is_map:
                save(drawn, tmp_path / picture.file, 4)
            size = drawn.size if isinstance(drawn, Animation) else drawn.shape[1::-1]
            assert 150 < max(size) <= 1300
            prepared(fitting_cell_size(world, 240))  # as TensorBoard asks for it


def test_an_episode_in_text_tells_state_action_and_reward() -> None:
    world = chain(3)
    played = play(world, np.eye(2)[[1, 1, 1, 1]], 10, seed=0)
    assert played.states.tolist() == [0, 1, 2, 3]
    assert played.actions.tolist() == [1, 1, 1]
    assert played.rewards.tolist() == [-0.5, -0.5, 1.0]
    assert played.beginning(2).actions.tolist() == [1]
    told = film(EnvConfig(), world, [played, played], True, 10)(None)
    assert len(told) == 8
    pictures = [np.asarray(told.draw(key).convert("RGB")) for key in told.keys]
    assert np.array_equal(pictures[0], pictures[4])
    assert len({picture.tobytes() for picture in pictures}) == 4
    assert ansi(world, 2) == "state 2\n"
    assert (draw_frame(world, 2) < 128).any()


def _noisy(env: GymnasiumConfig, mdp: Mdp, episodes: Sequence[Episode]) -> list[NDArray[np.uint8]]:
    """Frames of more colours than a palette has."""
    ramp, blue = np.indices((40, 80)).transpose(1, 2, 0), np.zeros((40, 80, 1), dtype=int)
    states = [state for each in episodes for state in each.states]
    return [np.concatenate([3 * ramp, blue + 100 * state], axis=2).astype(np.uint8) for state in states]


def test_an_episode_shows_the_frames_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episode, "rendered_frames", _noisy)
    env = GymnasiumConfig(id="FrozenLake-v1")
    walk = Episode(np.array([2, 0, 2, 1]), np.zeros(3, dtype=int), np.zeros(3))
    prepared = film(env, FROZEN_LAKE, [walk], True, 100)
    shown = prepared(None)
    assert shown.size == (80, 40)
    pictures = [np.asarray(shown.draw(key).convert("RGB")).astype(int) for key in shown.keys]
    for picture, frame in zip(pictures, _noisy(env, FROZEN_LAKE, [walk]), strict=True):
        assert np.abs(picture - frame).mean() < 12
    assert np.array_equal(pictures[0], pictures[2])
    assert prepared(5).size == (30, 15)  # a board with such cells has six of them on a side
    assert prepared(100).size == (80, 40)


def test_foreign_frames_of_few_colours_stay_exact() -> None:
    frames = [np.full((4, 6, 3), colour, dtype=np.uint8) for colour in (TRAP, AGENT, TRAP)]
    shown = animation_of_rendered(frames)
    colours = [tuple(np.asarray(shown.draw(key).convert("RGB"))[0, 0]) for key in shown.keys]
    assert colours == [TRAP, AGENT, TRAP]


# ---- frames of an episode, rendered by the environment that a world was made from --------------------------


def frames_of(env_id: str, states: list[int], mdp: Mdp | None = None, actions: Sequence[int] = (), **kwargs):
    config, taken = GymnasiumConfig(id=env_id, kwargs=kwargs), np.zeros(len(states) - 1, dtype=int)
    taken[: len(actions)] = actions
    walk = Episode(np.array(states), taken, np.zeros(len(taken)))
    return rendered_frames(config, mdp or config.compile(), [walk])


@pytest.mark.parametrize(
    ("env_id", "states", "size"),
    [
        ("FrozenLake-v1", [0, 4, 8, 4], (256, 256)),
        ("CliffWalking-v1", [36, 24, 25, 24], (256, 768)),
        ("Taxi-v4", [1, 101, 201, 101], (456, 536)),
    ],
)
def test_an_environment_with_a_table_is_put_into_each_state(env_id, states, size):
    before = dict(os.environ)
    frames = frames_of(env_id, states)
    assert [frame.shape for frame in frames] == [(*size, 3)] * 4
    assert frames[0].dtype == np.uint8
    assert np.array_equal(frames[1], frames[3])
    changed = [(one != other).any(axis=2) for one, other in itertools.pairwise(frames)]
    assert all(0 < each.mean() < 0.15 for each in changed)  # the agent, and no more
    assert {name: value for name, value in os.environ.items() if "SDL" in name} == {
        name: value for name, value in before.items() if "SDL" in name
    }


@pytest.mark.slow
def test_an_enumerated_environment_takes_the_same_walk():
    name, short = "MiniGrid-Empty-5x5-v0", {"max_steps": 12}
    mdp = compile_id(name, short)
    env = gym.make(name, render_mode="rgb_array", **short)
    env.reset(seed=5)
    states, expected = [int(mdp.start_states[0])], [env.render()]
    actions = (2, 1, 5, 2, 0, 0, 1, 2, 2)
    for action in actions:
        env.step(action)
        states.append(int(mdp.next_state[states[-1], action, 0]))
        expected.append(env.render())
    env.close()
    assert np.array_equal(frames_of(name, states, mdp, actions, **short), expected)
    assert {*mdp.panel_names} == {f"facing {way}" for way in ("right", "down", "left", "up")}
    assert mdp.places is not None
    assert mdp.places.max(axis=0).tolist() == [3, 2, 2]  # 3 x 3 cells, once for each direction
    facing_right = (mdp.places == 0).all(axis=1)  # at the start, at all steps from 0 to 12
    assert (board_of(mdp).summed(np.ones(mdp.num_states))[facing_right] == facing_right.sum()).all()
    assert facing_right.sum() > 2


def test_large_frames_are_made_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episode, "_MOST_PIXELS", 30_000)
    frame, *_ = frames_of("CliffWalking-v1", [36])
    assert frame.shape == (100, 300, 3)


@pytest.mark.parametrize(
    ("env_id", "words"),
    [
        ("NoSuchWorld-v0", "is not registered with Gymnasium .*doesn't exist"),
        ("Pendulum-v1", r"cannot be rendered: [^\n]*$"),
        ("Blackjack-v1", "its steps are random, so it cannot be led"),
    ],
)
def test_what_cannot_be_rendered_is_one_sentence(env_id, words):
    with pytest.raises(InputError, match=f"^env.id={env_id}: {words}"):
        frames_of(env_id, [36, 24, 25], FROZEN_LAKE if env_id == "Blackjack-v1" else CLIFF_WALKING)


def test_an_environment_that_draws_nothing_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = gym.envs.registration.EnvSpec("Plain-v0", entry_point="helpers.faulty_envs:Deaf")
    monkeypatch.setitem(gym.registry, "Plain-v0", spec)
    with pytest.raises(InputError, match=r"^env.id=Plain-v0: draws no pictures; rgb_array is not among"):
        frames_of("Plain-v0", [36], CLIFF_WALKING)


# ---- what captions of an episode say -----------------------------------------------------------------------


def captions(
    mdp: Mdp, states: list[int], actions: list[int], limit: int, monkeypatch
) -> list[tuple[str, str]]:
    monkeypatch.setattr(episode, "animation_of_states", lambda mdp, states, size, captions: captions)
    rewards = mdp.reward[states[:-1], actions, 0]
    told: Any = film(EnvConfig(), mdp, [Episode(np.array(states), np.array(actions), rewards)], True, limit)
    return list(told(None))


def test_captions_say_what_an_agent_does_that_does_not_move(monkeypatch: pytest.MonkeyPatch) -> None:
    classic, rooms = compile_mdp(load("classic")), compile_mdp(load("four_rooms"))
    assert captions(classic, [0, 0, 1, 0], [3, 1, 3], 3, monkeypatch) == [
        ("step 0 of 3, return 0", "moves left into the border"),
        ("step 1 of 3, return 0", "moves right"),
        ("step 2 of 3, return 0", "moves left"),
        ("step 3 of 3, return 0", "out of steps"),
    ]
    assert captions(classic, [17, 16], [3], 100, monkeypatch)[-1] == ("step 1 of 100, return 1", "the goal")
    assert captions(classic, [4, 10], [2], 100, monkeypatch)[-1] == ("step 1 of 100, return -1", "a trap")
    beside = int(np.flatnonzero(rooms.wall & ~np.roll(rooms.wall, 1))[0]) - 1  # a wall is on its right
    assert captions(rooms, [beside, beside], [1], 9, monkeypatch)[0][1] == "moves right into a wall"


def test_captions_say_where_chance_and_falls_lead(monkeypatch: pytest.MonkeyPatch) -> None:
    slipped = captions(FROZEN_LAKE, [0, 1, 1], [1, 1], 100, monkeypatch)
    assert [what for _, what in slipped] == [
        f"moves down, comes to {FROZEN_LAKE.state_name(1)}",
        "moves down, but stays",
        "and so on",
    ]
    assert captions(CLIFF_WALKING, [36, 36], [1], 9, monkeypatch)[0][1] == "moves right, but stays"
    assert captions(TAXI, [1, 1], [4], 9, monkeypatch)[0][1] == f"action {TAXI.action_names[4]}"
