"""A certificate of a run's policy: all that proves how good it is, in one file that anybody can check.

It has the world's rows, the policy, and bounds of what it and every policy are worth (`world.proof`). What
checks it, `scripts/check_certificate.py`, imports nothing of this package and computes in exact fractions.
"""

from __future__ import annotations

import contextlib
import gzip
import json
import math
import os
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import module_from_spec
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import gridworld
from gridworld.base.atomic_write import write_bytes
from gridworld.base.console import printable
from gridworld.base.errors import InputError, reason
from gridworld.base.user_input import as_path, limited
from gridworld.run.folder import check_file
from gridworld.training.saved_run import SavedRun
from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.evaluation import Evaluator, PolicySnapshot
from gridworld.world.mdp import FloatArray, IntArray, steps_from
from gridworld.world.proof import at_most

_MOST_EXACT = 1_000_000  # outcomes of all rows: about half a minute in fractions
_ROUNDED = 12  # digits of values that may be meant as round numbers, without a discount
_MORE = 1e-6  # of the expected steps to the end, which need only be a bound
_BEGINS = b'{"claim": '
_CLAIM = (
    "Under the discount gamma, the policy is worth at least the lower bounds where it goes, and no policy is "
    "worth more than the upper bounds."
)


@dataclass(frozen=True)
class Verified:
    """What is proven of a policy.

    Attributes:
        regret: no policy is worth more than this much more, from the start; infinite if nothing is proven.
        is_optimal: whether that is within the tolerance of "certified optimal".
        is_exact: whether it was checked in fractions; else by floats whose rounding is bounded.
        certificate: the content of the certificate's file; empty if nothing is proven.
    """

    regret: float
    is_optimal: bool
    is_exact: bool
    certificate: dict[str, Any] = field(repr=False)

    def __str__(self) -> str:
        """A sentence with the bound."""
        if not self.certificate:
            return "nothing is proven: at this discount its values are known by floating point alone"
        found = self.certificate
        how = "in exact fractions" if self.is_exact else "by floats whose rounding is bounded"
        optimal = "optimal: " if self.is_optimal else ""
        return (
            f"{optimal}no policy is worth more than {at_most(self.regret)} more, proven {how} for "
            f"{len(found['world']):,} states (rows {found['digest']})"
        )

    def write(self, path: Path) -> None:
        """Write the certificate as JSON, compressed if the name ends with .gz."""
        if not self.certificate:
            raise InputError(f"{path}: not written, since {self}")
        check_certificate_file(path)
        content = json.dumps(self.certificate).encode()
        write_bytes(path, gzip.compress(content, mtime=0) if path.name.endswith(".gz") else content)


def check_certificate_file(path: Path) -> None:
    """Refuse a place where no certificate can be written, or where something else is than an older one."""
    try:
        os.fsencode(path)
        check_file(path, "file")
        if path.exists():
            with (gzip.open if path.name.endswith(".gz") else open)(path, "rb") as file:
                if file.read(len(_BEGINS)) != _BEGINS:
                    raise InputError(f"{path}: is there and not a certificate; choose a new file")
    except InputError:
        raise
    except (OSError, EOFError, ValueError) as error:
        raise InputError(f"{printable(str(path)[:80])}: cannot be written: {reason(error)}") from None


@limited()
def verify(run: Any, out: str | PathLike[str] | None = None, *, best: bool = False) -> Verified:
    """Prove how good a finished run's greedy policy is, with a certificate that anybody can check.

    Args:
        run: its folder, or an opened run. Its world is read from its own files, and none of its code is run.
        out: a file for the certificate; compressed if its name ends with .gz.
        best: whether to prove its best model, not its last one.

    Returns:
        `regret`, `is_optimal`, `is_exact`, and the `certificate`; its text is a sentence.

    Raises:
        InputError: no finished run; nothing is proven, and a file is asked for; there is something else.
    """
    place = None if out is None else as_path("verify: out", out)
    if place is not None:
        check_certificate_file(place)
    saved = getattr(run, "saved", None)
    if saved is None or best:
        saved = SavedRun(as_path("verify: run", getattr(run, "folder", run)), best=best)
    snapshot: PolicySnapshot = saved.snapshot()
    verified = proven(saved.evaluator(), snapshot.greedy)
    if place is not None:
        verified.write(place)
    return verified


def proven(evaluator: Evaluator, greedy: IntArray) -> Verified:
    """What can be proven of the policy that takes these actions (S,)."""
    mdp, bounds, best = evaluator.mdp, evaluator.bounds, evaluator.solution.v
    chain = Chain(mdp, one_hot_policy(greedy, mdp.num_actions))
    values = evaluator.values(chain)
    if bounds is not None:
        candidates = [(bounds.upper, bounds.bound(values, chain.policy))]
    else:
        candidates = [(best, values), (np.round(best, _ROUNDED), np.round(values, _ROUNDED))]
        optimum, live = Chain(mdp, evaluator.optimal_policy()), (~mdp.absorbing).astype(np.float64)
        with np.errstate(invalid="ignore"):  # what may never end has no bound
            rounding = 8 * np.finfo(np.float64).eps * np.abs(best[mdp.reachable]).max()
            above, below = (rounding * each.total(live, 1.0) for each in (optimum, chain))
            candidates.append((best + above, values - below))
    checker, size = _checker(), np.count_nonzero(mdp.probability[mdp.reachable])
    for upper, lower in candidates:
        if not np.isfinite([upper, lower])[:, mdp.reachable].all():
            continue
        found = _certificate(evaluator, chain, upper, lower)
        found["digest"] = checker.digest_of(found)
        if bounds is not None and size > _MOST_EXACT:
            regret = bounds.at_start(upper - lower)
            return Verified(regret, regret <= evaluator.tolerance, is_exact=False, certificate=found)
        with contextlib.suppress(ValueError):
            most, least = checker.check(checker.parsed(json.dumps(found)))
            regret = checker.outwards(most - least, math.inf)
            return Verified(regret, regret <= evaluator.tolerance, is_exact=True, certificate=found)
    return Verified(math.inf, is_optimal=False, is_exact=False, certificate={})


def _certificate(evaluator: Evaluator, chain: Chain, upper: FloatArray, lower: FloatArray) -> dict[str, Any]:
    """The content of a certificate, without its digest."""
    mdp, gamma, steps = evaluator.mdp, evaluator.solution.gamma, {}
    taken = (mdp.probability > 0) & (chain.policy > 0)[:, :, None]
    live = mdp.reachable & ~mdp.terminal
    entered = np.flatnonzero((steps_from(mdp.start_states, mdp.next_state, taken) >= 0) & live).tolist()
    states = np.flatnonzero(live).tolist()
    if gamma == 1 and lower[entered].max(initial=0.0) > 0:
        ending = (1 + _MORE) * chain.total((~mdp.absorbing).astype(np.float64), 1.0)
        steps = {str(state): float(ending[state]) for state in entered}
    table = [mdp.probability.tolist(), mdp.next_state.tolist(), mdp.reward.tolist()]
    world = {
        str(state): [
            [list(outcome) for outcome in zip(*row, strict=True) if outcome[0] > 0]
            for row in zip(*(part[state] for part in table), strict=True)
        ]
        for state in states
    }
    return {
        "claim": _CLAIM,
        "scope": mdp.scope,
        "gamma": gamma,
        "start": [[state, float(mdp.start[state])] for state in mdp.start_states.tolist()],
        "ended": np.flatnonzero(mdp.reachable & mdp.terminal).tolist(),
        "world": world,
        "policy": {str(state): int(chain.policy[state].argmax()) for state in entered},
        "upper": {str(state): float(upper[state]) for state in states},
        "lower": {str(state): float(lower[state]) for state in entered},
        "steps": steps,
    }


def _checker() -> ModuleType:
    """`check_certificate.py`, which is no part of the package: beside an installed one, or in `scripts/`."""
    around = Path(gridworld.__file__).parents[1]
    places = (around / "gridworld_check_certificate.py", around / "scripts" / "check_certificate.py")
    loader = SourceFileLoader("check_certificate", str(next(each for each in places if each.exists())))
    module = module_from_spec(ModuleSpec(loader.name, loader))
    loader.exec_module(module)
    return module
