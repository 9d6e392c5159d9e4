"""Building a run from its settings: the world, the environments, and the checks before training."""

from __future__ import annotations

import dataclasses
import functools
from importlib.util import find_spec

import numpy as np

from gridworld.agents import TrainingContext, WriteScalars
from gridworld.base.errors import InputError, install_command
from gridworld.config.recipes import GROUP, NONE, agent_and_recipe, is_world, recipe_of_class
from gridworld.config.train import PICTURES, TrainConfig, check
from gridworld.config.words import CLASSES, conf_folder
from gridworld.config.worlds import World, compiled
from gridworld.envs.observations import make_observation
from gridworld.envs.training_env import TrainingVectorEnv
from gridworld.world.chain import Chain, discounted_visits, one_hot_policy, stopping_states
from gridworld.world.evaluation import Evaluator, fitting_discounts, score_of_optimum
from gridworld.world.mdp import Mdp
from gridworld.world.solver import solved

_with_exploring_starts = functools.lru_cache(4)(Mdp.with_exploring_starts)  # runs of a population share it
SAME = 1e-9  # of the scale of the values: actions that differ by less are worth the same
_QUICKLY_SOLVED = 6000  # outcomes of all states and actions


def check_settings(config: TrainConfig, world: World = compiled) -> Mdp:
    """Check everything that can be checked without the agent's library; returns the run's world."""
    check(config)
    config.agent.check(config)
    mdp = world(config.env)
    config.env.step_limit(mdp)
    if config.logging.wandb and find_spec("wandb") is None:
        raise InputError(f"logging.wandb=true: wandb is not installed; {install_command('wandb')}")
    wanted = config.recording
    if wanted.mp4:
        from gridworld.visualization.files import require_video

        require_video()
    if wanted.cell_size is not None and (wanted.learning or wanted.frames or wanted.gif or wanted.mp4):
        from gridworld.envs.rendering import frame_size

        frame_size(mdp, wanted.cell_size)
    return mdp


def make_context(config: TrainConfig, mdp: Mdp, write_scalars: WriteScalars | None = None) -> TrainingContext:
    """Make `config.n_envs` fresh environments, and what else an agent is built from."""
    share = config.exploring_starts
    return TrainingContext(
        envs=TrainingVectorEnv(
            config.n_envs,
            exploration_bonus=config.exploration_bonus,
            max_episode_steps=config.env.step_limit(mdp),
            mdp=_with_exploring_starts(mdp, share) if share else mdp,
            stratified=config.stratified_draws,
        ),
        observation=make_observation(mdp, config.observation.kind, config.observation.cell_size),
        seed=config.seed,
        device=config.device,
        threads=config.threads,
        write_scalars=write_scalars,
        callbacks=config.callbacks,
        features=config.observation.policy_kwargs(),
    )


def import_for(config: TrainConfig) -> None:
    """Import what a run of this configuration takes, for processes that are forked from this one."""
    from gridworld.visualization.picture import drawer

    config.agent.import_libraries()
    for name, picture in PICTURES.items():
        if getattr(config.recording, name):
            drawer(picture.drawer)


def without_pictures(config: TrainConfig) -> TrainConfig:
    """The same settings without pictures, which take time, or an extra that may be missing."""
    none = dict.fromkeys(PICTURES, False)
    return dataclasses.replace(
        config,
        recording=dataclasses.replace(config.recording, **none),
        logging=dataclasses.replace(config.logging, policy_map_every=0),
    )


def notes(config: TrainConfig, mdp: Mdp) -> list[str]:
    """What a user should know of the settings before training: where they come from, what they cannot do."""
    failure = config.known_failure
    fails = None if failure is None else f"agent={config.agent.name} is known to fail: {failure}"
    return [note for note in (_recipe_note(config, mdp), fails, objective_note(config, mdp)) if note]


def _recipe_note(config: TrainConfig, mdp: Mdp) -> str | None:
    """Which recipe a run has, why, and how to leave it out; or which one would suit it."""
    agent, recipe = agent_and_recipe(config)
    size = f"{mdp.name} has {mdp.num_states:,} states"
    why = f"{mdp.name} is stochastic" if mdp.is_stochastic else size
    if recipe is None:
        fitting = recipe_of_class(agent, config, lambda: mdp)
        return None if fitting is None else f"{why}; for settings that suit it, add {GROUP}={fitting}"
    own, _, name = recipe.rpartition("/")
    other = [] if own == agent else ["agent"]
    is_shipped = (conf_folder() / "env" / f"{name}.yaml").is_file()
    if is_shipped and name not in config.env.recipes_of and not is_world(config.env, name):
        other.append("world")
    reason = f", since {why}" if name in CLASSES else ""
    reason = f", tuned for another {' and '.join(other)}" if other else reason
    steps = f"{config.total_timesteps:,} steps"
    return f"recipe {recipe}{reason}: {steps}; {GROUP}={NONE} keeps the agent's own settings"


def objective_note(config: TrainConfig, mdp: Mdp) -> str | None:
    """Say that no agent with this discount can be certified, or only by luck, with what would be right.

    A world that takes longer than some tens of milliseconds to solve is not looked at.
    """
    gamma, judged = getattr(config.agent, "gamma", None), config.evaluation.gamma
    if gamma in (None, judged) or mdp.probability.size > _QUICKLY_SOLVED:
        return None
    judge = Evaluator(mdp, judged, config.env.step_limit(mdp))
    try:
        score, own = score_of_optimum(judge, float(gamma)), solved(mdp, float(gamma))
    except InputError:  # no finite optimum
        return None
    if score.certified:
        alike = own.q >= own.v[:, None] - SAME * own.scale[:, None]
        if config.agent.algorithm == "value_iteration":  # of equals, it takes what comes nearer to the end
            alike = own.optimal
        rank = np.where(alike, np.maximum(judge.solution.q, np.finfo(np.float64).min), np.inf)
        worst = judge.score(one_hot_policy(rank.argmin(axis=1), mdp.num_actions))
        if worst.certified:
            return None
        mistake = f"wrong actions are worth as much as the right ones (a regret of {worst.regret:.2g})"
    else:
        mistake = f"its optimum has a regret of {score.regret:.2g} under evaluation.gamma={judged:g}"
        mistake += ", too much for a certificate"
    key = config.agent.key("gamma")
    return f"{key.lstrip('+')}={gamma:g}: {mistake}; use {key}={recommended_gamma(judge):g}"


def recommended_gamma(judge: Evaluator) -> float:
    """Of discounts with the judge's optimum, that under which the right actions stand out most.

    By the smallest gap in the states that an episode of the optimal policy comes to most often.
    """
    chain = Chain(judge.mdp, judge.optimal_policy())
    visits = discounted_visits(chain, 1.0, stopping_states(chain, 1.0)) * judge.mdp.acting
    often = visits >= visits.max() / 2

    def smallest_gap(gamma: float) -> float:
        best = solved(judge.mdp, gamma)
        others = np.where(best.optimal, -np.inf, best.q).max(axis=1)
        return float((best.v - others)[often].min())

    return max(fitting_discounts(judge), key=smallest_gap)
