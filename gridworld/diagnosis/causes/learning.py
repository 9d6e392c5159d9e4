"""Causes in how a run learns: too slowly, too fast, or not for long enough."""

from __future__ import annotations

from inspect import signature

import numpy as np

from gridworld.base.bounds import LINEAR
from gridworld.diagnosis.evidence import (
    Evidence,
    Finding,
    costliest,
    entropy,
    entropy_optimum,
    falling,
    faster,
    longer,
    on_the_way,
    percent,
    slower,
    visits_needed,
)
from gridworld.world.mdp import BoolArray, backup

_SPREAD = 0.5  # of the entropy of a uniform policy: above, it has hardly made up its mind
_FORGOTTEN = 0.05  # of a first value
_SMALL, _LARGE = 0.02, 50  # values that networks hardly learn
_MOVES = 0.1  # Adam moves a weight by about the learning rate an update: less than this in all is nothing
_MOST_TIMES = 50  # as long
_EVENLY = "n_envs=256 exploring_starts=1 stratified_draws=true"  # what leaves least to chance
_GRADIENT = 1e-3  # what each weight's gradient should have without an optimiser that scales it
_FEW_UPDATES = 500  # of a network: fewer are too few whatever its target or its rate
_FAST = 4  # times the usual rate
_REFRESHES = 2  # of the target network, for each step of the way to the goal


def lost_again(run: Evidence) -> Finding | None:
    """The curve has a certificate that the end has not."""
    certified = np.flatnonzero(run.curve["certified"])
    if not certified.size:
        return None
    steps, last = run.curve["step"], int(certified[-1])
    after = int(steps[min(last + 1, len(steps) - 1)])
    why = f"it was certified at step {int(steps[last]):,} but no longer at step {after:,}"
    sooner = () if run.config.evaluation.stop_after else ("evaluation.stop_after=3",)
    calmer = _settling(run) if run.is_tabular and visits_needed(run) else slower(run)
    return Finding("lost", run.split.wrong, why, (*falling(run), *sooner, calmer[0]))


def diverged(run: Evidence) -> Finding | None:
    """A network's values are higher than those of any policy, by more than two rewards."""
    known = run.mdp.acting & (run.visits.sum(axis=1) > 0)
    if run.is_tabular or not known.any():
        return None
    highest, possible = float(run.values[known].max()), float(run.own.v[known].max())
    if highest <= possible + 2 * run.largest_reward:
        return None
    why = f"its values diverged: they reach {highest:.3g}, while no policy earns more than {possible:.3g}"
    interval = run.setting("target_update_interval")
    rarely = (run.change("target_update_interval", 4 * interval),) if interval else ()
    return Finding("diverged", run.split.wrong, why, (slower(run)[0], *rarely))


def scaled(run: Evidence) -> Finding | None:
    """Its `reward_scale` makes the values to be learned far from those of an untrained network."""
    if run.is_tabular or not run.takes("reward_scale"):
        return None
    scale, largest = run.setting("reward_scale", 1.0), float(np.abs(run.own.v[run.mdp.acting]).max())
    if scale == 1 or _SMALL <= scale * largest <= _LARGE:
        return None
    reach = f"with its reward_scale of {scale:g}, its values should reach {scale * largest:.2g}"
    why = f"{reach}; those of an untrained network are about 0.1"
    return Finding("scale", run.split.wrong, why, (run.change("reward_scale", 1 / run.largest_reward),))


def clipped(run: Evidence) -> Finding | None:
    """`max_grad_norm` leaves gradients that are small beside the number that the optimiser adds to theirs."""
    most = run.setting("max_grad_norm", np.inf)
    optimizer = getattr(getattr(run.agent.model, "policy", None), "optimizer", None)
    if optimizer is None or most == np.inf or not run.takes("max_grad_norm"):
        return None
    (group,) = optimizer.param_groups
    each = most / sum(weights.numel() for weights in group["params"]) ** 0.5
    if each >= group.get("eps", _GRADIENT):
        return None
    why = f"its gradients are clipped to max_grad_norm={most:g}, which leaves too little to learn from"
    usual = signature(type(run.agent.model)).parameters["max_grad_norm"].default
    return Finding("clipping", run.split.wrong, why, (run.change("max_grad_norm", usual or 10.0),))


def hardly_moved(run: Evidence) -> Finding | None:
    """All updates together are too small to have moved a network's weights."""
    rate = run.setting("learning_rate")
    has_own_step = run.setting("cg_max_steps") > 0  # TRPO's, whatever the rate
    moves = run.updates * rate >= _MOVES
    if run.is_tabular or has_own_step or moves or _too_short(run, run.split.wrong):
        return None
    why = f"{run.updates:,.0f} updates at a learning rate of {rate:g} cannot move a weight far"
    late = run.setting("learning_starts") > run.config.total_timesteps / 2
    starts = (run.change("learning_starts", 100),) if late else ()
    return Finding("slow", run.split.wrong, why, (*starts, *faster(run)))


def overshot(run: Evidence) -> Finding | None:
    """A policy that is far more decided than its entropy bonus would leave it."""
    bonus = run.last_setting("ent_coef")
    if not run.is_actor_critic or bonus <= 0:
        return None
    aim = entropy(entropy_optimum(run, bonus))
    states = run.split.wrong & (2 * run.spread + 0.1 < aim)
    if not states.any():
        return None
    worst = costliest(run, states)
    why = (
        f"its updates overshoot: in {run.mdp.state_name(worst)} its policy has {percent(run.spread[worst])} "
        f"of the maximum entropy, while its bonus of {bonus:g} aims at {percent(aim[worst])}"
    )
    return Finding("rate", states, why, slower(run))


def not_there_yet(run: Evidence) -> Finding | None:
    """Its values lag behind: a backup is nearer to the truth; or its policy is hardly decided."""
    if run.is_actor_critic:
        states = run.split.wrong & (run.spread > _SPREAD)
    else:
        ahead = backup(run.mdp, np.where(run.mdp.terminal, 0.0, run.q.max(axis=1)), run.gamma)
        now, then = (np.abs(each - run.own.q).max(axis=1) for each in (run.q, ahead))
        residual = np.abs(ahead - run.q).max(axis=1)
        states = run.split.wrong & ((then < now) | (residual < now / 2))
    if not states.any():
        return None
    if short := _too_short(run, states):
        return short
    if run.is_tabular:
        return _slow_table(run, states)
    interval, tau = run.setting("target_update_interval"), run.setting("tau", 1.0)
    refreshed = run.config.total_timesteps / max(interval, 1.0)
    path = run.evaluator.optimum.expected_length
    if interval and run.updates >= _FEW_UPDATES and tau * refreshed < _REFRESHES * path:
        by, whole = (f" by {percent(tau)}", f" {run.change('tau', 1.0)}") if tau < 1 else ("", "")
        why = (
            f"its target network was refreshed {refreshed:.0f} times{by}, but a value needs {path:.0f} "
            f"{'whole ' * (tau < 1)}refreshes to travel from the goal to the start"
        )
        often = run.change("target_update_interval", max(1.0, round(run.config.total_timesteps / (8 * path))))
        return Finding("target", states, why, (often + whole, longer(run, 4)))
    rate = run.setting("learning_rate")
    if run.is_actor_critic and run.updates >= _FEW_UPDATES and rate > _FAST * run.usual_rate:
        why = (
            f"its updates are too large: after {run.updates:,.0f} at a learning rate of {rate:g}, its policy"
        )
        return Finding("rate", states, f"{why} is hardly decided", slower(run))
    why = f"it was still learning: {run.updates:,.0f} updates were too few"
    return Finding("slow", states, why, faster(run))


def _too_short(run: Evidence, states: BoolArray) -> Finding | None:
    """A run that is too short at any rate: a random walk needs longer to meet the goal."""
    total, needed = run.config.total_timesteps, run.steps_to_goal
    if not total < needed < np.inf:
        return None
    why = f"it was still learning after {total:,} steps; a random walk finds the goal once in {needed:,.0f}"
    return Finding("budget", states, why, (longer(run, 10),))


def _slow_table(run: Evidence, states: BoolArray) -> Finding | None:
    """What its step sizes have left of the first value; None where that is nothing."""
    first, possible = run.setting("initial_value"), float(run.own.v[run.mdp.acting].max())
    worst = costliest(run, states)
    where, expects = run.mdp.state_name(worst), float(run.q[worst].max())
    if first > possible and expects > possible * (1 + 1e-9):
        why = (
            f"it is still optimistic: in {where} it expects {expects:.3g}, but the best earns {possible:.3g}"
        )
        return Finding("slow", states, why, (run.change("initial_value", possible), longer(run, 4)))
    rate, power = run.setting("learning_rate"), run.setting("learning_rate_power")
    tried = int(run.visits[worst][run.own.optimal[worst]].max())
    sizes = rate * np.arange(1, tried + 1, dtype=np.float64) ** -power
    left = float(np.prod(1 - np.minimum(sizes, 1.0)))
    if left < _FORGOTTEN:
        return None
    why = (
        f"its values have not converged: in {where}, the initial values still make up {percent(left)} after "
        f"{'1 update' if tried == 1 else f'{tried:,} updates'}"
    )
    changes = [run.change("learning_rate_power", 0.0)] if power else []
    if rate < run.usual_rate:  # with as many updates, enough of it
        enough = (1 - _FORGOTTEN ** (1 / max(tried, 1))) / rate
        changes.append(run.multiplied("learning_rate", max(10, enough), most=run.usual_rate))
    return Finding("slow", states, why, (*changes, longer(run, 4)))


def unsettled(run: Evidence) -> Finding:
    """What remains: its values err by more than what the right action is worth."""
    if short := _too_short(run, run.split.wrong):
        return short
    worst = costliest(run, run.split.wrong)
    error = float(np.abs(run.q - run.own.q)[worst].max())
    why = (
        f"its values do not settle: in {run.mdp.state_name(worst)} they are off by {error:.2g}, but the "
        f"right action is worth only {run.gap[worst]:.2g} more"
    )
    return Finding("rate", run.split.wrong, why, _settling(run))


def _settling(run: Evidence) -> tuple[str, ...]:
    """Smaller steps; of a table such as forget its first values, or average enough of random targets."""
    if not run.is_tabular:
        return slower(run)[0], *falling(run), longer(run, 4)
    way = on_the_way(run)
    tried = float(np.where(run.own.optimal, run.visits, 0).max(axis=1)[way].min())
    if needed := visits_needed(run):
        times = int(np.clip(needed / max(tried, 1.0), 4, _MOST_TIMES))
        fades = run.change("learning_rate", f"{LINEAR}{run.usual_rate:g}")
        if run.config.agent.algorithm == "q_learning":  # whose values do not depend on how it explores
            always = (run.change(f"exploration_{end}_eps", 1.0) for end in ("initial", "final"))
            fades = " ".join([fades, *always])
        return f"{longer(run, times)} {fades}", f"{longer(run, 16 * times)} {fades} {_EVENLY}"
    rates = [each for each in (0.5, 0.1) if each < run.setting("learning_rate")]
    forgetful = [each for each in rates if (1 - each) ** tried < _FORGOTTEN]
    return *(run.change("learning_rate", each) for each in forgetful), longer(run, 4)
