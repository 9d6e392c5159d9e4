"""The causes in the order in which they are believed: a state belongs to the first that claims it.

First what would be wrong for a perfect learner too, then what it could not know, then how it learns, and last
what remains.
"""

from __future__ import annotations

from gridworld.diagnosis.causes import exploration, implementation, learning, network, objective
from gridworld.diagnosis.evidence import Cause

# fmt: off
CAUSES: tuple[Cause, ...] = (
    implementation.faulty_class,
    objective.hopeless_gamma, objective.other_optimum, objective.too_much_epsilon, objective.too_much_entropy,
    learning.scaled, network.forgets, learning.lost_again, learning.diverged, network.cannot_represent,
    exploration.never_random, learning.clipped, learning.hardly_moved, learning.overshot,
    network.spoilt_policy,
    exploration.not_tried, exploration.collapsed,
    objective.faint_gamma, network.spoilt,
    learning.not_there_yet, exploration.ended_early, learning.unsettled,
)
# fmt: on

PHRASES = {  # by name
    "implementation": "the class is wrong",
    "objective": "discount does not fit",
    "lost": "lost its certificate again",
    "diverged": "values diverged",
    "epsilon": "plays safe for epsilon",
    "network": "network cannot hold it",
    "scale": "rewards scaled badly",
    "forgetting": "forgets what it learned",
    "clipping": "gradients clipped too small",
    "entropy": "entropy bonus too large",
    "rate": "updates too large",
    "exploration": "too little exploration",
    "budget": "too few steps",
    "target": "target network too old",
    "slow": "was still learning",
}
