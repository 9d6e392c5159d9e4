"""A world as text for the model checker Storm, which proves other statements about it, or solves it apart.

Reference: Storm's explicit format DRN, https://www.stormchecker.org/documentation/background/languages.html
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from gridworld.world.mdp import Mdp


def drn_lines(mdp: Mdp) -> Iterator[str]:
    """The lines of a DRN file: the states in their order, with the labels `init`, `goal`, `trap` and `over`.

    A reward is that of the action, in expectation. If there are several starts, one more state, the last,
    leads to them without a reward.
    """
    size, starts = mdp.num_states, mdp.start_states.tolist()
    extra = len(starts) > 1
    yield "@type: MDP\n@parameters\n\n@reward_models\nreward\n"
    yield f"@nr_states\n{size + extra}\n@nr_choices\n{size * mdp.num_actions + extra}\n@model\n"
    names = [re.sub(r"\W+", "_", name) for name in mdp.action_names]
    labels = {"init": np.isin(np.arange(size), starts) & (not extra), "goal": mdp.goal, "trap": mdp.trap}
    labels["over"] = mdp.terminal
    leads_to, probable = mdp.next_state.tolist(), mdp.probability.tolist()
    paid = np.einsum("sak,sak->sa", mdp.probability, mdp.reward).tolist()
    for state in range(size):
        yield " ".join([f"state {state}", *(name for name, has in labels.items() if has[state])]) + "\n"
        for action, name in enumerate(names):
            yield f"\taction {name} [{paid[state][action]!r}]\n"
            chances: dict[int, float] = {}
            for following, chance in zip(leads_to[state][action], probable[state][action], strict=True):
                chances[following] = chances.get(following, 0.0) + chance
            yield from (
                f"\t\t{following} : {each!r}\n" for following, each in sorted(chances.items()) if each
            )
    if extra:
        yield f"state {size} init\n\taction begin [0]\n"
        yield from (f"\t\t{start} : {float(mdp.start[start])!r}\n" for start in starts)
