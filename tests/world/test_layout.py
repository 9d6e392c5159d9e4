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
    layout, world = parse("\n".join(rows), "map"), World(rows)
    cells = {tile: {cell for cell, t in world.tile.items() if t == tile} for tile in "SGTC#"}
    assert (layout.num_rows, layout.num_cols) == (len(rows), len(rows[0]))
    assert list(layout.cells()) == world.cells
    assert [layout.state(cell) for cell in world.cells] == list(range(len(world.cells)))
    assert [set(layout.starts), set(layout.goals), set(layout.traps)] == [cells[tile] for tile in "SGT"]
    assert set(layout.walls) == cells["#"]
    assert set(layout.cliffs) == cells["C"]
    assert set(layout.terminals) == cells["G"] | cells["T"]
    assert layout.terminals[0] in cells["G"]


@given(maps())
def test_text_and_parse_undo_each_other(rows):
    text = "\n".join(rows)
    layout = parse(text, "map")
    assert layout.text() == text
    assert parse(layout.text(), "map") == layout


@pytest.mark.parametrize(
    ("raw", "mistake"),
    [
        (b"S.x.\n...G\n", r"row 1, column 3: unknown tile 'x'"),
        (b"S...\n.g.G\n", r"row 2, column 2: unknown tile 'g'"),
        (b"S.\t.\n...G\n", r"row 1, column 3: unknown tile '\\t'"),
        (b"S...\n..G\n", r"row 2 has 3 columns, row 1 has 4"),
        (b"S...\n....\n....G\n", r"row 3 has 5 columns, row 1 has 4"),
        (b"S...\n\n...G\n", r"row 2 has 0 columns, row 1 has 4"),
        (b"....\n...G\n", r"no start.*'S'"),
        (b"S...\n...T\n", r"no goal.*'G'"),
        (b"", r"empty"),
        (b"\n \r\n\n", r"empty"),
        (b"\xef\xbb\xbf", r"empty"),
        (b"S.#.\n..#G\n", r"no goal can be reached from the start in row 1, column 1"),
        (b"S#.S\n##.G\n", r"no goal can be reached from the start in row 1, column 1"),
        (b"..TG\nS.TT\n", r"no goal can be reached from the start in row 2, column 1"),
        (b"..CG\nS.TC\n", r"no goal can be reached from the start in row 2, column 1"),
        (b"S.SG\n..CS\n", r"a cliff 'C' sends back to the start, and there are 3; leave one 'S'"),
        (b"\x89PNG\r\n\x1a\n\x00\xff\xd8", r"not a text file.*byte 1 "),
        (b"S..G\xff\n", r"not a text file.*byte 5 "),
        (b"S" + b"." * 262143 + b"G", r"too large.*262144"),
        (b"S" * 2_000_000, r"too large.*262144"),
    ],
)
def test_a_mistake_in_a_map_is_told_with_its_place(tmp_path, raw, mistake):
    path = tmp_path / "my_map.txt"
    path.write_bytes(raw)
    with pytest.raises(InputError, match=f"(?s)my_map.txt: .*{mistake}"):
        load(path)
    with pytest.raises(InputError, match=mistake):
        GridWorldEnv(layout=str(path))


def test_the_largest_map_is_still_read():
    rows = ["." * 512] * 512
    rows[0], rows[-1] = "S" + "." * 511, "." * 511 + "G"
    layout = parse("\n".join(rows), "vast")
    assert (layout.num_rows, layout.num_cols, layout.goals) == (512, 512, ((511, 511),))


@pytest.mark.parametrize(
    "raw",
    [
        b"S..\r\n.TG\r\n",
        b"\xef\xbb\xbfS..\n.TG",
        b"S..\n.TG\n\n  \n\n",
        b"S..  \n.TG \n",
        b"\xef\xbb\xbfS..\r\n.TG\r\n\r\n",
    ],
    ids=["crlf", "byte order mark", "blank lines at the end", "blanks at the end of rows", "all of it"],
)
def test_what_editors_add_is_no_part_of_the_map(tmp_path, raw):
    path = tmp_path / "map.txt"
    path.write_bytes(raw)
    assert load(path).text() == "S..\n.TG"
    assert load(str(path)) == load(path)


@pytest.mark.parametrize("name", ["no_such_map", "missing/map.txt", "nul\0byte"])
def test_a_missing_map_lists_the_shipped_ones(name):
    with pytest.raises(InputError, match="shipped") as error:
        load(name)
    assert all(shipped in str(error.value) for shipped in SHIPPED)


def test_what_need_not_end_is_no_map(tmp_path):
    (tmp_path / "link").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    for path in ("/dev/zero", tmp_path / "link", tmp_path / "pipe"):
        with pytest.raises(InputError, match="is no ordinary file"):
            load(path)


def test_a_directory_is_no_map(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load(tmp_path)
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(InputError, match="nor a file"):
        load(file / "map.txt")


@pytest.mark.parametrize("layout", [None, 5, 1.5, "", b"classic", ["classic"], ("S", "G"), True])
def test_what_is_no_name_is_refused(layout):
    with pytest.raises(InputError, match="layout"):
        load(layout)


def test_the_shipped_layouts_load():
    assert shipped_layouts() == SHIPPED
    for name in SHIPPED:
        layout = load(name)
        assert layout.name == name
        assert parse(layout.text(), name).text() == layout.text()


def test_a_shipped_name_goes_before_a_file(tmp_path, monkeypatch):
    (tmp_path / "cliff").write_text("SG")
    monkeypatch.chdir(tmp_path)
    assert load("cliff").num_cols == 12
    assert load(Path("./cliff").absolute()).num_cols == 2


@pytest.mark.parametrize(
    ("num_rows", "num_cols"),
    [
        *[(rows, 6) for rows in (3, 2, 1, 0, -5, 5.0, "5", True, None, float("nan"))],
        *[(5, cols) for cols in (2, 1, 0, -1, 6.5, "6", None)],
        (600, 600),
    ],
)
def test_classic_refuses_what_cannot_hold_it(num_rows, num_cols):
    with pytest.raises(InputError, match=r"classic|num_rows|num_cols"):
        classic(num_rows, num_cols)
    with pytest.raises(InputError):
        GridWorldEnv(num_rows, num_cols)


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
        reason = "lies outside the grid|a start on a trap" if rows is None else "no goal can be reached"
        with pytest.raises(InputError, match=f"{num_rows} x {num_cols} cells: .*({reason}).* 4 rows and 3"):
            classic(num_rows, num_cols)
    assert won == set(itertools.product(range(4, 13), range(3, 13)))  # as the sentence says


def test_a_mistake_in_a_map_passes_between_processes():
    with pytest.raises(InputError) as told:
        parse("S.T", "map")
    again = pickle.loads(pickle.dumps(told.value))
    assert str(again) == str(told.value) == "map: there is no goal; mark at least one cell with 'G'"


@pytest.mark.parametrize(("num_rows", "num_cols"), [(7, 6), (5, 7), (4, 11), (12, 4)])
def test_a_size_that_contradicts_the_map_is_refused(tmp_path, num_rows, num_cols):
    path = tmp_path / "cliff.txt"
    path.write_text(load("cliff").text())
    for layout in ("cliff", path, load("cliff")):
        with pytest.raises(InputError, match=r"(num_rows=\d+.* 4|num_cols=\d+.* 12)"):
            load(layout, num_rows, num_cols)
        assert load(layout, 4, 12) == load(layout)


@pytest.mark.parametrize(
    ("changes", "mistake"),
    [
        ({"starts": ((1, 2),)}, "row 2, column 3: a start on a goal"),
        ({"starts": ((1, 0),)}, "row 2, column 1: a start on a wall"),
        ({"starts": ((0, 0), (0, 0))}, "row 1, column 1: a start on a start"),
        ({"cliffs": ((0, 3),)}, "row 1, column 4: this cliff lies outside"),
        ({"cliffs": ((0, 2),), "starts": ((0, 0), (0, 1))}, "a cliff 'C' sends back to the start"),
        ({"traps": ((-1, 0),)}, "this trap lies outside"),
        ({"walls": frozenset({(0, -1)})}, "this wall lies outside"),
        ({"traps": ((1, 1),), "walls": frozenset({(0, 1)})}, "no goal can be reached"),
        ({"num_rows": 0}, "num_rows"),
        ({"num_cols": 3.0}, "num_cols"),
        ({"num_rows": 1000, "num_cols": 1000}, "too large.*262144"),
    ],
)
def test_the_constructor_checks_as_the_parser_does(changes, mistake):
    valid = parse("S..\n#TG", "made")
    with pytest.raises(InputError, match=mistake):
        dataclasses.replace(valid, **changes)
