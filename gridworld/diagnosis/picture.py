"""Where the regret comes from, as a map: each state's share as a colour, and the greedy path into it."""

from __future__ import annotations

import numpy as np

from gridworld.diagnosis.verdict import Diagnosis
from gridworld.envs.rendering import AGENT, INK, Frame, board_of
from gridworld.visualization.canvas import Canvas, directions, greedy_paths
from gridworld.visualization.sheet import ORANGES, PAPER, UNREACHABLE, Swatch, is_dark, linear, short
from gridworld.visualization.state_table import StateTable, table_states
from gridworld.world.mdp import FloatArray


def draw_diagnosis(found: Diagnosis, cell_size: int | None = None) -> Frame:
    """Draw the split of a run's regret; `cell_size` in pixels, None: 80, less on large maps."""
    mdp, cost = found.mdp, np.maximum(found.split.cost, 0.0)
    cost = np.where(np.isfinite(cost) & (found.cause_of >= 0), cost, 0.0)
    causes = ", ".join(
        f"{each.cause} {share:.0%}" for each, share in zip(found.findings, found.shares, strict=True)
    )
    caption = f"regret {found.split.score.regret:.3g}: {causes}"
    if not board_of(mdp).panels:
        return _as_table(found, cost, caption)
    canvas = Canvas(mdp, cell_size)
    scale = linear(ORANGES, cost[canvas.board.floor], low=0.0)
    colours = scale.colours(cost)
    colours[cost == 0] = PAPER
    canvas.paint(colours[:, None])
    canvas.draw_world()
    ways = directions(mdp)[np.arange(mdp.num_states), found.greedy].tolist()
    paths = greedy_paths(mdp, found.greedy)
    canvas.draw_paths(paths, ways, 0.4)
    costly = np.flatnonzero((cost > 0) & canvas.board.floor).tolist()
    texts = {state: short(float(cost[state]), scale.high) for state in costly}
    size = canvas.number_size(0.8, texts.values())
    dark = is_dark(colours)
    for state, text in texts.items() if size is not None else ():
        ink = PAPER if dark[state] else INK
        canvas.number(text, canvas.point(state, 0.5, 0.83), size or 0, ink, colours[state])
    canvas.caption(caption)
    path = Swatch("greedy path from the start" if canvas.cell >= 24 else "greedy path", AGENT, PAPER)
    swatches = [*([path] if paths else []), *([UNREACHABLE] if canvas.hidden else [])]
    canvas.legend(scale, "regret 0", short(scale.high), swatches)
    return canvas.frame()


def _as_table(found: Diagnosis, cost: FloatArray, caption: str) -> Frame:
    """Of a world without places: its states in a column, by what they cost."""
    states = table_states(
        found.mdp, np.round(cost[:, None] * 1e12 / max(cost.max(), 1e-300)).astype(np.int64)
    )
    table = StateTable(found.mdp, states, ["regret"])
    scale = linear(ORANGES, cost[states], low=0.0)
    table.paint(np.where(cost > 0, cost, np.nan)[:, None], scale)
    table.caption(caption)
    table.legend(scale, "regret 0", short(scale.high))
    return table.frame()
