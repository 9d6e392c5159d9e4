"""A map: which cell is floor, wall, start, goal, trap or cliff.

Maps are text, one line a row and one sign a cell:

    S  start (several: each episode draws one of them, uniformly)
    G  goal, ends the episode
    T  trap, ends the episode; also H
    C  cliff: who steps here pays as for a trap, is back at the start at once, and the episode goes on
    #  wall, cannot be entered
    .  floor; also F

Any other capital letter is an end with a reward of its own, which a line above the map gives, as `A=10 B=-1`.
Those that pay more than 0 are goals, the others traps; in a map where nothing else is a goal, the best are.

`Layout` is the checked, immutable form: there is a start and a goal, no cell is two things, every start can
reach a goal without stepping on a trap or a cliff, and where there is a cliff, there is one start to be sent
back to.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from os import PathLike
from typing import Any, NamedTuple

from gridworld.base.bounds import positive_int
from gridworld.base.errors import InputError
from gridworld.base.user_input import as_path, read_users_file, users_folder

Cell = tuple[int, int]  # (row, column), both from 0, the top-left cell first

MAX_CELLS = 1024 * 1024
MOVES: tuple[Cell, ...] = ((-1, 0), (0, 1), (1, 0), (0, -1))  # up, right, down, left: action 0, 1, 2, 3

CLASSIC = "classic"
NUM_ROWS, NUM_COLS = 5, 6  # of classic
LEAST_ROWS, LEAST_COLS = 4, 3
_TILES = {**{tile: tile for tile in "SGTC#."}, "H": "T", "F": "."}


class End(NamedTuple):
    """The ends of one letter, with a reward of their own; each is among the goals or the traps."""

    letter: str
    reward: float
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Layout:
    """A checked map; the module says what the kinds of cells are. Raises InputError if it cannot be played.

    `name` is what messages call it; `num_rows` and `num_cols` are its height and width in cells.
    """

    name: str
    num_rows: int
    num_cols: int
    starts: tuple[Cell, ...]
    goals: tuple[Cell, ...]
    traps: tuple[Cell, ...] = ()
    walls: frozenset[Cell] = frozenset()
    cliffs: tuple[Cell, ...] = ()
    ends: tuple[End, ...] = ()

    def __post_init__(self) -> None:
        _check(self)

    @cached_property
    def terminals(self) -> tuple[Cell, ...]:
        """Cells that end an episode, goals first."""
        return self.goals + self.traps

    def cells(self) -> Iterable[Cell]:
        """All cells in the order of their state numbers."""
        return ((row, col) for row in range(self.num_rows) for col in range(self.num_cols))

    def state(self, cell: Cell) -> int:
        """The cell's state number, row by row from the top left."""
        return cell[0] * self.num_cols + cell[1]

    def text(self) -> str:
        """The map as text, one line a row, no newline at the end; `parse` reads it back.

        Rewards of ends are in a line above it.
        """
        grid = [["."] * self.num_cols for _ in range(self.num_rows)]
        kinds = (self.starts, self.goals, self.traps, self.cliffs, self.walls)
        for tile, cells in zip("SGTC#", kinds, strict=True):
            for row, col in cells:
                grid[row][col] = tile
        for end in self.ends:
            for row, col in end.cells:
                grid[row][col] = end.letter
        heading = [" ".join(f"{end.letter}={end.reward!r}".removesuffix(".0") for end in self.ends)]
        return "\n".join([*heading[: len(self.ends)], *map("".join, grid)])


def classic(num_rows: int = NUM_ROWS, num_cols: int = NUM_COLS) -> Layout:
    """The GridWorld of the tutorial: start in the corner, a goal with a trap on three of its sides.

    Only the cell right of the goal leads into it, by a way around the traps.
    """
    num_rows, num_cols = positive_int("num_rows", num_rows), positive_int("num_cols", num_cols)
    if num_rows < LEAST_ROWS or num_cols < LEAST_COLS:
        raise InputError(
            f"layout classic of {num_rows} x {num_cols} cells: has no room for the goal, its traps and a "
            f"way to it; give at least {LEAST_ROWS} rows and {LEAST_COLS} columns"
        )
    row, col = num_rows // 2, num_cols - 2
    traps = ((row + 1, col), (row, col - 1), (row - 1, col))
    return Layout(CLASSIC, num_rows, num_cols, starts=((0, 0),), goals=((row, col),), traps=traps)


def parse(text: str, name: str, rewards: Mapping[str, float] | None = None) -> Layout:
    """Read a map from its text: one line a row and one sign a cell; `name` is what messages call it.

    `rewards` are of ends by their letters, in place of those in the text.
    """
    lines = [line.rstrip() for line in text.replace("\r\n", "\n").replace("\r", "\n").split("\n")]
    while lines and not lines[-1]:
        lines.pop()
    if not lines:
        raise InputError(f"{name}: the map is empty; it needs at least a start 'S' and a goal 'G'")
    paid = _paid(name, lines.pop(0) if "=" in lines[0] else "", rewards or {})
    if not lines:
        raise InputError(f"{name}: there is no map below the rewards of its ends")
    _check_size(name, len(lines), len(lines[0]))  # before there is an object for each cell
    found: dict[str, list[Cell]] = {tile: [] for tile in [*_TILES, *paid]}
    for row, line in enumerate(lines):
        for col, tile in enumerate(line):
            if tile not in found:
                raise InputError(
                    f"{name}: row {row + 1}, column {col + 1}: unknown tile {tile!r}; use S (start), G "
                    "(goal), T or H (trap), C (cliff), # (wall) and . or F (floor), or give the reward of "
                    "an end in the first line, as A=10"
                )
            found[_TILES.get(tile, tile)].append((row, col))
        if len(line) != len(lines[0]):
            raise InputError(
                f"{name}: row {row + 1} has {len(line)} columns, row 1 has {len(lines[0])}; all rows must "
                "have equal lengths"
            )
    ends = tuple(End(letter, paid[letter], tuple(found[letter])) for letter in sorted(paid))
    best = 0.0 if found["G"] else max((end.reward for end in ends), default=0.0)
    is_best = [end.reward > 0 or (not found["G"] and end.reward == best) for end in ends]
    for end, is_goal in zip(ends, is_best, strict=True):
        found["G" if is_goal else "T"] += end.cells
    starts, goals, traps, cliffs = (tuple(found[tile]) for tile in "SGTC")
    return Layout(name, len(lines), len(lines[0]), starts, goals, traps, frozenset(found["#"]), cliffs, ends)


def _paid(name: str, heading: str, rewards: Mapping[str, float]) -> dict[str, float]:
    """The reward of each end by its letter, from the line above a map and the rewards in place of its."""
    from gridworld.world.mdp import checked_reward  # here, with numpy, which `--help` does not need

    if not isinstance(rewards, Mapping):
        raise InputError(
            f"rewards={str(rewards)[:50]}: must be a mapping of letters to rewards, as {{A: 10}}"
        )
    paid: dict[str, Any] = {}
    for word in heading.split():
        letter, _, number = word.partition("=")
        try:
            paid[letter] = float(number)
        except ValueError:
            raise InputError(
                f"{name}: first line: {word[:50]!r} is not the reward of an end; must be as A=10"
            ) from None
    for letter in (paid := paid | dict(rewards)):
        if not re.fullmatch("[A-Z]", str(letter)) or letter in _TILES:
            known = ", ".join(filter(str.isalpha, _TILES))
            raise InputError(f"{name}: {str(letter)[:20]!r} cannot be an end; use A to Z, but not {known}")
    return {letter: checked_reward(f"{name}: reward of {letter}", each) for letter, each in paid.items()}


def load(
    layout: str | PathLike[str] | Layout,
    num_rows: int | None = None,
    num_cols: int | None = None,
    rewards: Mapping[str, float] | None = None,
) -> Layout:
    """Get a layout.

    Args:
        layout: `classic`, the name of a shipped map, the path of a map file, or a layout.
        num_rows: sizes `classic`. A map has its own size; where one is given, it must agree.
        num_cols: the same.
        rewards: of ends by their letters, in place of the map's own.

    Raises:
        InputError: no such map, or one that could not be played.
    """
    if isinstance(layout, str) and layout == CLASSIC:
        rows, cols = NUM_ROWS if num_rows is None else num_rows, NUM_COLS if num_cols is None else num_cols
        layout = classic(rows, cols)
    if not isinstance(layout, Layout):
        loaded = _read(layout, rewards)
    else:
        loaded = parse(layout.text(), layout.name, rewards) if rewards else layout
    for what, asked in (("num_rows", num_rows), ("num_cols", num_cols)):
        actual = getattr(loaded, what)
        if asked is not None and positive_int(what, asked) != actual:
            raise InputError(
                f"{what}={asked}: the map {loaded.name} has {actual}; leave {what} out, it only applies to "
                "the layout classic"
            )
    return loaded


def shipped_layouts() -> tuple[str, ...]:
    """Names of all layouts that come with the package."""
    maps = (entry.name for entry in files("gridworld").joinpath("layouts").iterdir())
    return tuple(sorted([CLASSIC, *(name.removesuffix(".txt") for name in maps if name.endswith(".txt"))]))


def _read(layout: str | PathLike[str], rewards: Mapping[str, float] | None) -> Layout:
    path = users_folder() / as_path("layout", layout)
    name = os.fspath(layout)
    if name in shipped_layouts():
        return parse(files("gridworld").joinpath("layouts", f"{name}.txt").read_text("utf-8"), name, rewards)
    if not os.path.exists(path):
        shipped = ", ".join(shipped_layouts())
        raise InputError(f"layout {name!r}: neither a shipped layout ({shipped}) nor a file")
    # A row may end in blanks or \r\n; far more than that is not a map, and is not read.
    content = read_users_file("layout", layout, "a readable text file", 4 * MAX_CELLS)
    try:
        return parse(content.decode("utf-8-sig"), name, rewards)
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: not a text file (byte {error.start + 1} is not UTF-8)") from None


def _check_size(name: str, num_rows: int, num_cols: int) -> None:
    if num_rows * num_cols > MAX_CELLS:
        raise InputError(
            f"{name}: {num_rows} rows of {num_cols} columns are too large; at most {MAX_CELLS} cells fit"
        )


def _check(layout: Layout) -> None:
    def refused(mistake: str, remedy: str) -> InputError:
        return InputError(f"{layout.name}: {mistake}; {remedy}")

    positive_int("num_rows", layout.num_rows)
    positive_int("num_cols", layout.num_cols)
    _check_size(layout.name, layout.num_rows, layout.num_cols)
    for what in ("start", "goal"):
        if not getattr(layout, f"{what}s"):
            raise refused(f"there is no {what}", f"mark at least one cell with {what[0].upper()!r}")
    kind: dict[Cell, str] = {}
    for what in ("goal", "trap", "wall", "cliff", "start"):
        for row, col in getattr(layout, f"{what}s"):
            where = f"row {row + 1}, column {col + 1}"
            if not (0 <= row < layout.num_rows and 0 <= col < layout.num_cols):
                raise refused(f"{where}: this {what} is outside the grid", "move it inside")
            if (row, col) in kind:
                raise refused(f"{where}: a {what} on a {kind[row, col]}", "a cell can be one thing only")
            kind[row, col] = what
    for letter, _, cells in layout.ends:
        if not cells or not set(cells) <= set(layout.terminals):
            raise refused(f"the end {letter!r} is not on the map", "mark its cells or leave out its reward")
    if layout.cliffs and len(layout.starts) > 1:
        raise refused(
            f"a cliff 'C' leads back to the start, but there are {len(layout.starts)}", "keep one 'S'"
        )
    reaching = _cells_that_reach_a_goal(layout)
    for row, col in [cell for cell in layout.starts if cell not in reaching]:
        raise refused(
            f"no goal can be reached from the start in row {row + 1}, column {col + 1}",
            "open a way past the walls, traps and cliffs",
        )


def _cells_that_reach_a_goal(layout: Layout) -> set[Cell]:
    """From the goals backwards; moves are symmetric between floor cells."""
    closed = layout.walls.union(layout.traps, layout.cliffs)
    seen, waiting = set(layout.goals), list(layout.goals)
    while waiting:
        row, col = waiting.pop()
        for down, right in MOVES:
            cell = row + down, col + right
            inside = 0 <= cell[0] < layout.num_rows and 0 <= cell[1] < layout.num_cols
            if inside and cell not in seen and cell not in closed:
                seen.add(cell)
                waiting.append(cell)
    return seen
