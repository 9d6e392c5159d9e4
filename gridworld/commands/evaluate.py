"""Score a finished run again: exactly, and by playing episodes."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence

from gridworld.base.console import aligned, coloured, printable, program, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.user_input import limited
from gridworld.commands import parser_of, whole
from gridworld.envs.env import GridWorldEnv
from gridworld.envs.rendering import has_display
from gridworld.envs.rollout import SampledScores, play, sample_episodes
from gridworld.run.console import MOST_NAMED, circles_text, shortfall_text
from gridworld.training.saved_run import SavedRun, choose_policy
from gridworld.world.evaluation import Evaluator, Score
from gridworld.world.mdp import BY_CONSTRUCTION, FloatArray
from gridworld.world.metrics import METRICS, optimal_score
from gridworld.world.proof import at_most

_MOST_EPISODES = 1_000_000


@limited()
def main(arguments: Sequence[str]) -> None:
    """Print the scores."""
    options = _parser().parse_args(arguments)
    if options.render == "human" and not has_display():
        raise InputError(
            "--render human: there is no display to open a window on; set DISPLAY, or use "
            f"{program('record')}"
        )
    with telling_if_slow(f"evaluating {options.run}"):
        saved = SavedRun(options.run, options.trust, options.best)
        evaluator = saved.evaluator(options.layout)
        policy = choose_policy(saved.snapshot(), options.policy)
    if options.render == "human":
        _show(evaluator, policy, options.seed)
    with telling_if_slow(f"evaluating {options.run}"):
        score = evaluator.score(policy)
        sampled = sample_episodes(evaluator, policy, options.episodes, options.seed)
        table, proven = _table(evaluator, policy, score, sampled), score.proven_regret
        if score.certified:
            bound = (
                "by floating point" if proven is None else f"the regret is at most {at_most(proven)}, proven"
            )
            verdict = f"certified optimal: {bound}"
        else:
            states = evaluator.endless_states(policy)
            names = [evaluator.mdp.state_name(state) for state in states[:MOST_NAMED]]
            circles = circles_text(len(states), names, score.outcome.timeout)
            verdict = shortfall_text(score.regret, proven, circles)
    of = f"{options.run} (best model, step {saved.steps():,})" if options.best else options.run
    print(printable(f"{options.policy} policy of {of} on {evaluator.mdp.name}"))
    print(table)
    print(f"  {coloured(verdict, score.certified)}")
    if score.scope != BY_CONSTRUCTION:
        print(printable(f"  world: {score.scope}"))


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(
        "evaluate", __doc__, "run", "--policy", "--best", "--trust", example="runs/mine --policy sampled"
    )
    option = parser.add_argument
    option("--layout", help="score on another map of the same size: a name or a file")
    option(
        "--episodes", type=whole(1, _MOST_EPISODES), default=1000, help="episodes to sample (default 1000)"
    )
    option("--seed", type=whole(0), default=0, help="seed of the sampled episodes (default 0)")
    option("--render", choices=("human",), help="show one episode in a window first")
    return parser


def _table(evaluator: Evaluator, policy: FloatArray, score: Score, sampled: SampledScores) -> str:
    """Exact scores, the optimum, and sampled scores of the same horizon; if narrow, intervals."""
    best = optimal_score(evaluator)
    estimates = {
        "goal_probability": sampled.goal,
        "trap_probability": sampled.trap,
        "timeout_probability": sampled.timeout,
        "return": sampled.episode_return,
        "length": sampled.length,
    }
    discounted = [f"{evaluator.discounted_return(each):.4g}" for each in (policy, evaluator.optimal_policy())]
    rows = [
        ["", "exact", "optimum", f"{sampled.episodes:,} episodes [95 %]"],
        ["without a step limit:", "", "", ""],
        ["value", f"{score.value:.4g}", f"{evaluator.optimal_value:.4g}", ""],
        [f"within {evaluator.max_episode_steps:,} steps:", "", "", ""],
        ["discounted return", *discounted, str(sampled.discounted_return)],
    ]
    for metric in METRICS:
        if metric.within_limit:
            exact, optimum = (metric.text(metric.of(each)) for each in (score, best))
            rows.append([metric.label, exact, optimum, str(estimates.get(metric.name, ""))])
    is_narrow = shutil.get_terminal_size().columns < 70
    for row in rows:
        row[3] = row[3][row[3].find("[") :] if is_narrow else f" {row[3]}"
    rows[0][3] = "sampled [95 %]" if is_narrow else rows[0][3]
    return "\n".join(f"  {line}" for line in aligned(rows, ("<20", ">8", ">8", "<0")))


def _show(evaluator: Evaluator, policy: FloatArray, seed: int) -> None:
    """Play one episode in a window."""
    env = GridWorldEnv(render_mode="human", mdp=evaluator.mdp)
    try:
        for state in play(evaluator.mdp, policy, evaluator.max_episode_steps, seed).states:
            env.state = state
            env.render()
    finally:
        env.close()
