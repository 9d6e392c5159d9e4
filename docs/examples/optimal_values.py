"""The exact optimum of Gymnasium's small environments: python docs/examples/optimal_values.py [NAME ...]."""

import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

import gridworld

DISCOUNTS = (0.99, 1)
HEADER = """\
| environment | discount | *V*\\* | return | length | goal |
|---|--:|--:|--:|--:|--:|"""


def on_map(arrows: str, letters: Any, mdp: gridworld.Mdp, actions: Any) -> str:
    """A map of letters with an arrow in each cell from which the episode continues."""
    cells = letters.copy()
    for state in np.flatnonzero(mdp.acting):
        cells.flat[mdp.number[state]] = arrows[actions[state]]
    return "\n".join(map(" ".join, cells))


def lake(env: Any, mdp: gridworld.Mdp, actions: Any) -> str:
    """FrozenLake's map."""
    return on_map("←↓→↑", env.desc.astype(str), mdp, actions)


def cliff(env: Any, mdp: gridworld.Mdp, actions: Any) -> str:
    """CliffWalking's map."""
    letters = np.full(env.shape, "C")
    letters[-1, -1] = "G"
    return on_map("↑→↓←", letters, mdp, actions)


def taxi(env: Any, mdp: gridworld.Mdp, actions: Any) -> str:
    """A map per place that the taxi may have to go to; to a passenger it goes as with one to that place."""
    chosen = dict(zip(mdp.number[mdp.acting], actions[mdp.acting], strict=True))
    maps = []
    for place, name in enumerate("RGYB"):
        lines = [f"to {name}"]
        for row in range(5):
            moves = [chosen[env.encode(row, column, 4, place)] for column in range(5)]
            waiting = [chosen[env.encode(row, column, place, (place + 1) % 4)] for column in range(5)]
            assert waiting == [4 if move == 5 else move for move in moves]
            lines.append(" ".join("↓↑→←PD"[move] for move in moves))
        maps.append([line.ljust(9) for line in lines])
    return "\n".join("     ".join(lines).rstrip() for lines in zip(*maps, strict=True))


def blackjack(env: Any, mdp: gridworld.Mdp, actions: Any) -> str:
    """Two tables, without and with a usable ace: the player's sum by the dealer's card."""
    chosen: dict[tuple[int, ...], int] = {}
    for state in np.flatnonzero(mdp.acting):
        hand = tuple(mdp.own_observation[state].tolist())
        assert chosen.setdefault(hand, actions[state]) == actions[state]  # what is hidden changes nothing
    dealer = (*range(2, 11), 1)
    head = "    " + "  ".join("A" if card == 1 else str(card) for card in dealer)
    tables = []
    for ace, title in enumerate(("without a usable ace", "with a usable ace")):
        lines = [title, head]
        for total in range(21, 3, -1):
            hands = [(total, card, ace) for card in dealer]
            if hands[0] in chosen:
                lines.append(f"{total:2}  " + "  ".join("SH"[chosen[hand]] for hand in hands))
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


def route(env: Any, mdp: gridworld.Mdp, actions: Any) -> str:
    """The actions of the episode, where nothing is random."""
    [state], words = mdp.start_states, []
    while not mdp.terminal[state]:
        words.append(mdp.action_names[actions[state]])
        state = mdp.next_state[state, actions[state], 0]
    return ", ".join(words)


Picture = Callable[[Any, gridworld.Mdp, Any], str]
WORLDS: dict[str, tuple[str, dict[str, Any], Picture]] = {  # by name: the id, its arguments, the picture
    "FrozenLake-v1": ("FrozenLake-v1", {}, lake),
    "FrozenLake-v1, not slippery": ("FrozenLake-v1", {"is_slippery": False}, lake),
    "FrozenLake8x8-v1": ("FrozenLake8x8-v1", {}, lake),
    "FrozenLake8x8-v1, not slippery": ("FrozenLake8x8-v1", {"is_slippery": False}, lake),
    "CliffWalking-v1": ("CliffWalking-v1", {}, cliff),
    "Taxi-v4": ("Taxi-v4", {}, taxi),
    "Blackjack-v1": ("Blackjack-v1", {}, blackjack),
    "MiniGrid-Empty-5x5-v0": ("MiniGrid-Empty-5x5-v0", {}, route),
}


def optimum(name: str) -> tuple[list[str], str]:
    """The rows of an environment, one per discount, and its optimal policy as text."""
    ident, arguments, picture = WORLDS[name]
    if ident.startswith("MiniGrid"):
        import minigrid  # noqa: F401  it registers its environments
    env = gym.make(ident, **arguments)
    mdp = gridworld.compile_env(env)
    rows, texts = [], []
    for gamma in DISCOUNTS:
        evaluator = gridworld.Evaluator(mdp, gamma, mdp.max_episode_steps or 100)
        policy = evaluator.optimal_policy()
        score = evaluator.score(policy)
        assert score.certified
        episode = score.outcome
        cells = [f"{evaluator.optimal_value:.6f}", f"{episode.expected_return:.6f}"]
        cells += [f"{episode.expected_length:.2f}", f"{100 * episode.goal:.1f} %"]
        rows.append(f"| {name} | {gamma} | {' | '.join(cells)} |")
        texts.append(picture(env.unwrapped, mdp, policy.argmax(axis=1)))
    if len(set(texts)) == 1:
        return rows, texts[0]
    parts = zip(DISCOUNTS, texts, strict=True)
    return rows, "\n\n".join(f"discount {gamma}:\n{text}" for gamma, text in parts)


def main(names: list[str]) -> None:
    """Print the table, then a section per environment."""
    found = {name: optimum(name) for name in names or WORLDS}
    print("\n".join([HEADER, *(row for rows, _ in found.values() for row in rows)]))
    for name, (_, text) in found.items():
        print(f"\n## {name}\n\n```text\n{text}\n```")


if __name__ == "__main__":
    main(sys.argv[1:])
