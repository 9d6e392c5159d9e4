"""Causes in a network, told by the oracle ablation: the same network, fitted to the exact answer.

Of all states at once, with new weights or its own, and of the costliest one alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gridworld.diagnosis.evidence import Evidence, Finding, costliest, slower
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import IntArray

if TYPE_CHECKING:
    from gridworld.diagnosis.oracle_fit import OneState

_FEW = 4  # transitions of a state in a replay buffer
_OFTEN = 10  # times as many visits


def cannot_represent(run: Evidence) -> Finding | None:
    """The same network with new weights cannot be fitted, or has a layer too narrow for the exact answer."""
    if _fits(run, fresh=True) is False:
        worst = costliest(run, run.split.wrong)
        found, name = _alone(run, worst), run.mdp.state_name(worst)
        can = found is None or found.told_apart
        alone = f"can learn {name} alone" if can else f"cannot even distinguish {name} from the others"
        how = f"with new weights and fitted to the exact answer, it still errs; as trained, it {alone}"
    elif units := _bottleneck(run):
        how = f"it has a layer of {units}, and even the best table of rank {units} errs"
    else:
        return None
    why = f"its network cannot hold the answer: {how}"
    wide = f"{run.config.agent.key('policy_kwargs.net_arch')}=[64,64]"
    kinds = () if run.config.observation.kind == "one_hot" else ("observation=one_hot",)
    return Finding("network", run.split.wrong, why, (wide, *kinds))


def forgets(run: Evidence) -> Finding | None:
    """States that were met often are hardly in the replay buffer, and to learn others spoils them."""
    size, total = run.setting("buffer_size"), run.config.total_timesteps
    if run.is_tabular or not 0 < size < total / _OFTEN:
        return None
    met = run.visits.sum(axis=1)
    kept = met / max(met.sum(), 1) * size
    states = run.split.wrong & (kept < _FEW) & (met >= _OFTEN * np.maximum(kept, 1.0))
    if not states.any():
        return None
    worst = costliest(run, states)
    found = _alone(run, worst)
    if found is None or not len(found.spoilt):
        return None
    where = run.mdp.state_name(worst)
    why = (
        f"it forgets: {where} was visited {met[worst]:,} times, of which {kept[worst]:.1g} are in its "
        f"replay buffer, and learning that state alone makes {len(found.spoilt)} others wrong"
    )
    return Finding("forgetting", states, why, (run.change("buffer_size", total),))


def spoilt_policy(run: Evidence) -> Finding | None:
    """As `spoilt`, of a policy that explores by itself: what it did not try follows from its weights."""
    return spoilt(run) if run.is_actor_critic else None


def spoilt(run: Evidence) -> Finding | None:
    """Its own weights cannot be fitted any more, where new ones can."""
    if _fits(run, fresh=False) is not False:
        return None
    why = "its weights are spoilt: fitted to the exact answer from them, it errs; from new ones it does not"
    return Finding("rate", run.split.wrong, why, slower(run))


def _bottleneck(run: Evidence) -> int:
    """The units of its narrowest layer, if no table of that rank near the exact one is optimal; else 0.

    What an output layer makes of w units is a table of rank w, besides a constant for each action. The one
    with the least squared error is the sum of the first w singular vectors (Eckart and Young, 1936).
    """
    if run.config.agent.family != "sb3":
        return 0
    from gridworld.diagnosis.oracle_fit import narrowest_layer  # imports torch

    units, states = narrowest_layer(run.agent), np.flatnonzero(run.mdp.acting)
    if not units or units >= run.mdp.num_actions or not np.isfinite(run.own.q[states]).all():
        return 0
    advantages = run.own.q[states] - run.own.v[states, None]
    mean = advantages.mean(axis=0)
    left, sizes, right = np.linalg.svd(advantages - mean, full_matrices=False)
    greedy = run.own.q.argmax(axis=1)
    greedy[states] = ((left[:, :units] * sizes[:units]) @ right[:units] + mean).argmax(axis=1)
    score = Evaluator(run.mdp, run.own.gamma, 1).score(one_hot_policy(greedy, run.mdp.num_actions))
    return 0 if score.certified else units


def _fits(run: Evidence, fresh: bool) -> bool | None:
    """Whether a network learns the exact optimum of its own objective; None: none, or too large to try."""
    if run.config.agent.family != "sb3" or run.own.gamma > 0.9999:  # where actions hardly differ
        return None
    from gridworld.diagnosis.oracle_fit import oracle_fit  # imports torch

    judge = Evaluator(run.mdp, run.own.gamma, 1)

    def is_optimal(greedy: IntArray) -> bool:
        return judge.score(one_hot_policy(greedy, run.mdp.num_actions)).certified

    return oracle_fit(run.agent, run.own, np.flatnonzero(run.mdp.acting), is_optimal, fresh)


def _alone(run: Evidence, state: int) -> OneState | None:
    """What comes of teaching its network one state only; None where that would take too long."""
    from gridworld.diagnosis.oracle_fit import one_state_fit  # imports torch

    return one_state_fit(run.agent, run.own, np.flatnonzero(run.mdp.acting), state)
