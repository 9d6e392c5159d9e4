"""A map is read exactly, and what is wrong with one is said where it stands."""

import dataclasses
import itertools
import os
import pickle
from pathlib import Path

import pytest
from helpers.oracle import World, maps
from hypothesis import given

from gridworld import GridWorldEnv, InputError, shipped_layouts
from gridworld.world.layout import classic, load, parse

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


@pytest.mark.parametrize(
    ("raw", "mistake"),
    [
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
        (b"S" + b"." * 262143 + b"G", r"too large.*262144"),
        (b"S" * 2_000_000, r"too large.*262144"),
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
        *((name, shipped) for name in ("no_such_map", "missing/map.txt", "nul\0byte", tmp_path / "file/map")),
        *((path, "is not an ordinary file") for path in ("/dev/zero", tmp_path / "link", tmp_path / "pipe")),
        (tmp_path, "cannot be read"),
        *((what, "^layout=") for what in (None, 5, 1.5, "", b"classic", ["classic"], ("S", "G"), True)),
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
        (600, 600),
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
        ({"num_rows": 1000, "num_cols": 1000}, "too large.*262144"),
    ],
)
def test_the_constructor_checks_as_the_parser_does(changes, mistake):
    with pytest.raises(InputError, match=mistake):
        dataclasses.replace(parse("S..\n#TG", "made"), **changes)
