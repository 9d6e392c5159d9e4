"""A map is read exactly, and what is wrong with one is said where it stands."""

import dataclasses
import itertools
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from helpers.oracle import World, maps
from hypothesis import given

from gridworld import GridWorldEnv, InputError, compile_mdp, make_vec_env, shipped_layouts
from gridworld.world.layout import classic, load, parse
from gridworld.world.solver import value_iteration

SHIPPED = (
    *("aima_4x3", "classic", "cliff", "cliff_walking", "four_rooms"),
    *("frozen_lake_4x4", "frozen_lake_8x8", "maze"),
)


@given(maps())
def test_every_tile_is_read_where_it_stands(rows):
    text = "\n".join(rows)
    layout, world = parse(text, "map"), World(rows)
    cells = {tile: {cell for cell, t in world.tile.items() if t == tile} for tile in "SGTC#"}
    assert (layout.num_rows, layout.num_cols, list(layout.cells())) == (len(rows), len(rows[0]), world.cells)
    assert [layout.state(cell) for cell in world.cells] == list(range(len(world.cells)))
    found = (layout.starts, layout.goals, layout.traps, layout.cliffs, layout.walls)
    assert dict(zip("SGTC#", map(set, found), strict=True)) == cells
    assert layout.terminals == layout.goals + layout.traps
    assert layout.text() == text
    assert parse(layout.text(), "map") == layout


@given(maps())
def test_letters_of_frozen_lake_mean_the_same(rows):
    text = "\n".join(rows)
    for lake in (text.replace(".", "F").replace("T", "H"), text.replace(".", "F", 1).replace("T", "H", 1)):
        layout = parse(lake, "map")
        assert layout == parse(text, "map")
        assert layout.text() == text


# Berkeley's CS188, project 3: gridworld.py and the solutions of its autograder, test_cases/q1. There the exit
# is a step of its own, so that its values are those of here, discounted once more.
BRIDGE = "A=10 B=-100 D=1\n#BBBBB#\nDS....A\n#BBBBB#"


def berkeley(text, gamma, slip):
    solution = value_iteration(compile_mdp(parse(text, "map"), slip=slip), gamma)
    return gamma * solution.v


def test_the_bridge_of_berkeley():
    found = berkeley(BRIDGE, 0.85, 0.1).reshape(3, 7)
    assert found[1, 1:6] == pytest.approx([-7.7350, -14.4173, -15.4999, -9.1502, -0.8500], abs=5e-5)


def test_the_discount_grid_of_berkeley():
    """The autograder's grid is another one's transpose: its columns are rows here."""
    rows = ["BBBBB", ".....", "A#D#.", "..." + "#.", "....."]
    found = berkeley("A=10 B=-10 D=1\n" + "\n".join(rows).replace(".", "S", 1), 0.9, 0.2).reshape(5, 5)
    assert found[1] == pytest.approx([8.4777, 5.7186, 3.3074, 2.0045, 2.9289], abs=5e-5)
    assert found[3:, [0, 1, 2, 4]] == pytest.approx(
        np.array([[8.6547, 7.5087, 6.0258, 3.9306], [7.5087, 6.6836, 5.8841, 4.4765]]), abs=5e-5
    )
    assert found[2, 4] == pytest.approx(3.4513, abs=5e-5)
    assert found[4, 3] == pytest.approx(5.1665, abs=5e-5)


@pytest.mark.parametrize(
    ("text", "goals", "traps"),
    [
        ("A=1 B=-1\nASB", "A", "B"),
        ("A=1 B=10 D=0\nASB.D", "AB", "D"),
        ("A=-1 B=-2 D=-1\nASB.D", "AD", "B"),
        ("A=0 B=-2\nGSA.B", "G", "AB"),
        ("A=3\nTSA.G", "GA", "T"),
    ],
)
def test_which_ends_are_goals(text, goals, traps):
    layout, row = parse(text, "map"), text.split("\n")[1]
    assert sorted(layout.goals) == sorted((0, row.index(letter)) for letter in goals)
    assert sorted(layout.traps) == sorted((0, row.index(letter)) for letter in traps)
    mdp = compile_mdp(layout, step_reward=-0.5, goal_reward=7, trap_reward=-7)
    paid = {"G": 7.0, "T": -7.0} | {end.letter: end.reward for end in layout.ends}
    for col, letter in enumerate(row):
        beside, action = (col - 1, 1) if col else (1, 3)
        if letter in paid:
            assert mdp.reward[beside, action, 0] == -0.5 + paid[letter]
    assert layout.text() == text
    assert parse(text, "map") == layout


def test_rewards_are_given_or_replaced(tmp_path):
    path = tmp_path / "ends.txt"
    path.write_text("A=1\nASB")
    changed = {"A": 2, "B": -0.125}
    layout = load(path, rewards=changed)
    assert layout.text() == "A=2 B=-0.125\nASB"
    assert load(parse("A=1\nSA", "made"), rewards={"A": 3}).ends[0].reward == 3
    for env in (GridWorldEnv(layout=path, rewards=changed), GridWorldEnv(layout=layout)):
        assert env.mdp.reward[1, 3, 0] == 2
        assert env.trap_cells == [(0, 2)]
    assert make_vec_env(str(path), rewards=changed).envs.mdp.reward[1, 1, 0] == -0.125
    for wrong, mistake in (
        ({**changed, "D": 1}, "the end 'D' is not on the map; mark its cells or leave out its reward"),
        ({**changed, "G": 1}, "'G' cannot be an end; use A to Z, but not S, G, T, C, H, F"),
        ({**changed, "A": "x"}, "reward of A=x: must be a number, 0, or from"),
        (3, "rewards=3: must be a mapping of letters to rewards"),
    ):
        with pytest.raises(InputError, match=mistake):
            load(path, rewards=wrong)
    with pytest.raises(InputError, match="the end 'A' is not on the map"):
        load("classic", rewards={"A": 1})
    with pytest.raises(InputError, match="has its own layout, slip and rewards"):
        GridWorldEnv(mdp=compile_mdp(layout), rewards={"A": 1})


@pytest.mark.parametrize(
    ("raw", "mistake"),
    [
        (b"A=x\nSA\n", r"first line: 'A=x' is not the reward of an end; must be as A=10"),
        (b"A=\nSA\n", r"first line: 'A=' is not the reward"),
        (b"A=nan\nSA\n", r"reward of A=nan: must be 0, or from"),
        (b"A=1e200\nSA\n", r"reward of A=1e\+200: must be 0, or from"),
        (b"a=1\nSa\n", r"'a' cannot be an end; use A to Z, but not S, G, T, C, H, F"),
        (b"A=1 T=1\nSA\n", r"'T' cannot be an end"),
        (b"A=1\n", r"there is no map below the rewards of its ends"),
        (b"A=1\nSG\n", r"the end 'A' is not on the map"),
        (b"SAG\n", r"row 1, column 2: unknown tile 'A'.* or give the reward of an end in the first line"),
        (b"S.x.\n...G\n", r"row 1, column 3: unknown tile 'x'"),
        (b"S.\t.\n...G\n", r"row 1, column 3: unknown tile '\\t'"),
        (b"S...\n....\n....G\n", r"row 3 has 5 columns, row 1 has 4"),
        (b"S...\n\n...G\n", r"row 2 has 0 columns, row 1 has 4"),
        (b"....\n...G\n", r"no start.*'S'"),
        (b"S...\n...T\n", r"no goal.*'G'"),
        (b"", r"empty"),
        (b"\n \r\n\n", r"empty"),
        (b"\xef\xbb\xbf", r"empty"),
        (b"S#.S\n##.G\n", r"no goal can be reached from the start in row 1, column 1"),
        (b"..TG\nS.TT\n", r"no goal can be reached from the start in row 2, column 1"),
        (b"..CG\nS.TC\n", r"no goal can be reached from the start in row 2, column 1"),
        (b"S.SG\n..CS\n", r"a cliff 'C' leads back to the start, but there are 3; keep one 'S'"),
        (b"\x89PNG\r\n\x1a\n\x00\xff\xd8", r"not a text file.*byte 1 "),
        (b"S..G\xff\n", r"not a text file.*byte 5 "),
        (b"S" + b"." * 1048575 + b"G", r"too large.*1048576"),
        (b"S" * 5_000_000, r"is larger than 4 MiB"),
    ],
)
def test_a_mistake_in_a_map_is_told_with_its_place(tmp_path, raw, mistake):
    path = tmp_path / "my_map.txt"
    path.write_bytes(raw)
    for read in (load, lambda path: GridWorldEnv(layout=str(path))):
        with pytest.raises(InputError, match=f"(?s)my_map.txt: .*{mistake}") as told:
            read(path)
        assert str(pickle.loads(pickle.dumps(told.value))) == str(told.value)  # between processes, too


def test_the_largest_map_is_still_read():
    rows = ["." * 512] * 512
    rows[0], rows[-1] = "S" + "." * 511, "." * 511 + "G"
    layout = parse("\n".join(rows), "vast")
    assert (layout.num_rows, layout.num_cols, layout.goals) == (512, 512, ((511, 511),))


@pytest.mark.parametrize("raw", [b"S..\r\n.TG\r\n", b"\xef\xbb\xbfS..\n.TG", b"S..  \n.TG \n\n  \n\n"])
def test_what_editors_add_is_no_part_of_the_map(tmp_path, raw):
    (tmp_path / "map.txt").write_bytes(raw)
    assert load(tmp_path / "map.txt").text() == "S..\n.TG"
    assert load(str(tmp_path / "map.txt")) == load(tmp_path / "map.txt")


def test_what_is_no_map_is_refused(tmp_path):
    (tmp_path / "link").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").touch()
    shipped = "neither a shipped layout .*" + ".*".join(SHIPPED)
    for layout, mistake in (
        *((name, shipped) for name in ("no_such_map", "missing/map.txt", tmp_path / "file/map")),
        *((path, "is not an ordinary file") for path in ("/dev/zero", tmp_path / "link", tmp_path / "pipe")),
        (tmp_path, "cannot be read"),
        *((what, "^layout=") for what in (None, "", "nul\0byte", b"classic", ["classic"], ("S", "G"), True)),
    ):
        with pytest.raises(InputError, match=mistake):
            load(layout)


def test_the_shipped_layouts_load_before_files(tmp_path, monkeypatch):
    assert shipped_layouts() == SHIPPED
    for name in SHIPPED:
        assert load(name).name == name
        assert parse(load(name).text(), name).text() == load(name).text()
    (tmp_path / "cliff").write_text("SG")
    monkeypatch.chdir(tmp_path)
    assert load("cliff").num_cols == 12
    assert load(Path("./cliff").absolute()).num_cols == 2


@pytest.mark.parametrize(
    ("num_rows", "num_cols"),
    [
        *[(rows, 6) for rows in (3, 0, -5, 5.0, "5", True, None, float("nan"))],
        *[(5, cols) for cols in (2, 0, 6.5)],
        (1100, 1100),
    ],
)
def test_classic_refuses_what_cannot_hold_it(num_rows, num_cols):
    for make in (classic, GridWorldEnv):
        with pytest.raises(InputError, match=r"classic|num_rows|num_cols"):
            make(num_rows, num_cols)


def formula(num_rows, num_cols):
    """Rows of the specification's world of that size; None where it does not hold the goal and its traps."""
    row, col = num_rows // 2, num_cols - 2
    tiles = {(row, col): "G", (row + 1, col): "T", (row, col - 1): "T", (row - 1, col): "T"}
    grid = [(r, c) for r in range(num_rows) for c in range(num_cols)]
    if not tiles.keys() <= set(grid) - {(0, 0)}:
        return None
    tiles[0, 0] = "S"
    return ["".join(tiles.get((r, c), ".") for c in range(num_cols)) for r in range(num_rows)]


def test_classic_takes_exactly_the_sizes_that_can_be_won():
    won = set()
    for num_rows, num_cols in itertools.product(range(1, 13), repeat=2):
        rows = formula(num_rows, num_cols)
        if rows is not None and World(rows).steps_to_goal((0, 0)) is not None:
            assert classic(num_rows, num_cols).text() == "\n".join(rows)
            won.add((num_rows, num_cols))
            continue
        with pytest.raises(
            InputError, match=f"{num_rows} x {num_cols} cells: has no room for .* 4 rows and 3"
        ):
            classic(num_rows, num_cols)
    assert won == set(itertools.product(range(4, 13), range(3, 13)))  # as the sentence says


def test_a_size_that_contradicts_the_map_is_refused(tmp_path):
    path = tmp_path / "cliff.txt"
    path.write_text(load("cliff").text())
    for layout in ("cliff", path, load("cliff")):
        for sizes, mistake in (((7, 12), r"num_rows=7: .* has 4"), ((4, 11), r"num_cols=11: .* has 12")):
            with pytest.raises(InputError, match=mistake):
                load(layout, *sizes)
        assert load(layout, 4, 12) == load(layout)


@pytest.mark.parametrize(
    ("changes", "mistake"),
    [
        ({"starts": ((1, 2),)}, "row 2, column 3: a start on a goal"),
        ({"starts": ((0, 0), (0, 0))}, "row 1, column 1: a start on a start"),
        ({"cliffs": ((0, 3),)}, "row 1, column 4: this cliff is outside"),
        ({"cliffs": ((0, 2),), "starts": ((0, 0), (0, 1))}, "a cliff 'C' leads back to the start"),
        ({"walls": frozenset({(0, -1)})}, "this wall is outside"),
        ({"traps": ((1, 1),), "walls": frozenset({(0, 1)})}, "no goal can be reached"),
        ({"num_rows": 0}, "num_rows"),
        ({"num_cols": 3.0}, "num_cols"),
        ({"num_rows": 1025, "num_cols": 1024}, "too large.*1048576"),
    ],
)
def test_the_constructor_checks_as_the_parser_does(changes, mistake):
    with pytest.raises(InputError, match=mistake):
        dataclasses.replace(parse("S..\n#TG", "made"), **changes)
