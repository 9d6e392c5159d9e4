"""The causes in the order in which they are believed: a state belongs to the first that claims it.

First what would be wrong for a perfect learner too, then what it could not know, then how it learns, and last
what remains.
"""

from __future__ import annotations

from gridworld.diagnosis.causes.exploration import collapsed, ended_early, not_tried
from gridworld.diagnosis.causes.implementation import faulty_class
from gridworld.diagnosis.causes.learning import (
    diverged,
    hardly_moved,
    lost_again,
    not_there_yet,
    overshot,
    scaled,
    unsettled,
)
from gridworld.diagnosis.causes.network import cannot_represent, forgets, spoilt, spoilt_policy
from gridworld.diagnosis.causes.objective import (
    faint_gamma,
    hopeless_gamma,
    other_optimum,
    too_much_entropy,
    too_much_epsilon,
)
from gridworld.diagnosis.finding import Cause

CAUSES: tuple[Cause, ...] = (
    *(faulty_class, hopeless_gamma, other_optimum, too_much_epsilon, too_much_entropy),
    *(scaled, forgets, lost_again, diverged, cannot_represent, hardly_moved, overshot),
    *(spoilt_policy, not_tried, collapsed, faint_gamma, spoilt, not_there_yet, ended_early, unsettled),
)

PHRASES = {  # by name
    "implementation": "the class is wrong",
    "objective": "discount does not fit",
    "lost": "lost its certificate again",
    "diverged": "values diverged",
    "epsilon": "plays safe for epsilon",
    "network": "network cannot hold it",
    "scale": "rewards scaled badly",
    "forgetting": "forgets what it learnt",
    "entropy": "entropy bonus too large",
    "rate": "updates too large",
    "exploration": "too little exploration",
    "budget": "too few steps",
    "target": "target network too old",
    "slow": "was still learning",
}
