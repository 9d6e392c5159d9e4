"""Values of settings that follow the world: the functions that the agents' yaml files call.

    ${adam_eps:${agent.policy_kwargs.optimizer_class},1e-6}  that number, or none for another optimiser
    ${clearest_gamma:${env},${evaluation.gamma},[0.9,0.95]}  see `world.recommendation`
    ${quadratic_scale:${env},${agent.gamma}}                 see there
    ${for_size:${env},30000}                        30000 up to 30 states, in larger worlds in proportion
    ${if_chance:${env},A,B}                         A where an action may have several outcomes, else B
    ${if_larger:${env},A,B}                         A where there are more than 30 states, else B
    ${features_class:${observation.kind},${agent.policy}}  of an MLP, for what the agent sees
    ${divided:${total_timesteps},600}               as a whole number, at least 1
    ${times:4,${n_envs}}                            the product
    ${minibatch:${agent.n_steps},${n_envs},${agent.engine},${callbacks}}  the rollout, or a part of it
    ${if_whole:${agent.batch_size},${agent.n_steps},${n_envs},A,B}  A where that is the rollout, else B
    ${replay_class:${env},${exploration_bonus},${callbacks},${agent.engine},${agent.n_steps}}  one that counts
    ${if_counts:${agent.replay_buffer_class},A,B}   A where transitions are counted, else B

They know the worlds of maps of up to 512 cells. Any other world, and settings that make none, get what the
default world gets; the check before training says what is wrong with the settings.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from dataclasses import astuple
from typing import TYPE_CHECKING, Any, cast

from omegaconf import DictConfig, ListConfig, OmegaConf

from gridworld.config.agents import REPLAY_COUNTS
from gridworld.config.plain_settings import has_own_code
from gridworld.config.worlds import MapConfig
from gridworld.errors import InputError

if TYPE_CHECKING:  # importing numpy takes longer than `--help` does
    from gridworld.world.mdp import Mdp

_FEATURES = {  # by the kind of observation
    "coordinates": "gridworld.agents.sb3.features.FourierFeatures",
    "image": "gridworld.agents.sb3.features.ImageCells",
}
_DEFAULT_CELLS = 30  # of the default world, whose settings were tuned
_MOST_CELLS = 512  # the rules solve the world a few times, which takes 0.3 s there


def register_world_rules() -> None:
    """Register these functions with OmegaConf."""
    for rule in (
        adam_eps,
        clearest_gamma,
        divided,
        features_class,
        for_size,
        if_chance,
        if_counts,
        if_larger,
        if_whole,
        minibatch,
        quadratic_scale,
        replay_class,
        times,
    ):
        OmegaConf.register_new_resolver(rule.__name__, rule, replace=True)


def adam_eps(optimizer_class: str | None, eps: float) -> float | None:
    """`eps` for SB3's own optimiser, Adam; None, its default, where another one was chosen."""
    return eps if optimizer_class in (None, "torch.optim.Adam") else None


def clearest_gamma(env: DictConfig, evaluation_gamma: float, candidates: Sequence[float]) -> float:
    """The discount to learn with in the world of the section `env`."""
    world = _world(env)
    try:
        return candidates[0] if world is None else _gamma(world, evaluation_gamma, tuple(candidates))
    except InputError:  # of the discount, or a world without a finite optimum
        return candidates[0]


def divided(number: int, by: int) -> int:
    """A number divided by another, rounded down, at least 1."""
    return max(1, number // by)


def features_class(kind: str, policy: str) -> str | None:
    """The import path of the features extractor for an observation of this kind; None: the policy's own."""
    return _FEATURES.get(kind) if policy == "MlpPolicy" else None


def for_size(env: DictConfig, number: int) -> int:
    """`number` in a world of up to 30 states, and in larger ones in proportion to their states."""
    world = _world(env)
    return number if world is None else number * max(world.num_states, _DEFAULT_CELLS) // _DEFAULT_CELLS


def if_chance(env: DictConfig, then: Any, otherwise: Any) -> Any:
    """`then` where an action may have several outcomes in the world of the section `env`."""
    from gridworld.world.recommendation import has_chance

    world = _world(env)
    return then if world is not None and has_chance(world) else otherwise


def if_counts(replay_buffer_class: str | None, then: Any, otherwise: Any) -> Any:
    """`then` with a replay buffer that counts transitions."""
    return then if replay_buffer_class == REPLAY_COUNTS else otherwise


def if_larger(env: DictConfig, then: Any, otherwise: Any) -> Any:
    """`then` where the world of the section `env` is larger than the default one."""
    world = _world(env)
    return then if world is not None and world.num_states > _DEFAULT_CELLS else otherwise


def if_whole(batch_size: int, n_steps: int, n_envs: int, then: Any, otherwise: Any) -> Any:
    """`then` where a minibatch is the whole rollout, so that the tabulated engine sums it up once."""
    return then if batch_size == n_steps * n_envs else otherwise


def minibatch(n_steps: int, n_envs: int, engine: str, callbacks: ListConfig) -> int:
    """The samples of a rollout; of one that SB3's own loop learns from, a quarter if four divide it."""
    whole = n_steps * n_envs
    return whole // 4 if _is_own_loop(engine, callbacks) and whole % 4 == 0 else whole


def quadratic_scale(env: DictConfig, gamma: float) -> float | None:
    """What rewards are multiplied with in the world of the section `env`; None: they stay as they are."""
    from gridworld.world.recommendation import quadratic_scale as scale

    world = _world(env)
    try:
        return None if world is None else scale(world, gamma)
    except InputError:  # of the discount
        return None


def replay_class(
    env: DictConfig, exploration_bonus: float, callbacks: ListConfig, engine: str, n_steps: int
) -> str | None:
    """The import path of a replay buffer that counts, for the world of the section `env`; None: SB3's own.

    It is of use where an action has several outcomes, and large minibatches of it cost nothing in the
    tabulated engine. Its transitions are single steps, whose rewards do not change from visit to visit.
    """
    fits = not (exploration_bonus or _is_own_loop(engine, callbacks) or n_steps != 1)
    return if_chance(env, REPLAY_COUNTS, None) if fits else None


def times(number: int, by: int) -> int:
    """The product."""
    return number * by


def _is_own_loop(engine: str, callbacks: ListConfig) -> bool:
    """Whether SB3's own loop trains, which runs the network on every sample."""
    return engine != "tabulated" or has_own_code(OmegaConf.to_container(callbacks))


def _world(env: DictConfig) -> Mdp | None:
    if OmegaConf.get_type(env) is not MapConfig:
        return None
    try:
        config = MapConfig(**cast(dict[str, Any], OmegaConf.to_container(env)))
        stamp = os.stat(config.layout).st_mtime_ns if os.path.isfile(config.layout) else None
        return _compiled(astuple(config), stamp)
    except (InputError, TypeError, ValueError, OSError):
        return None


@functools.lru_cache(maxsize=16, typed=True)  # reading a large map takes longer than composing
def _compiled(settings: tuple[Any, ...], stamp: int | None) -> Mdp | None:
    mdp = MapConfig(*settings).compile()
    return mdp if mdp.num_states <= _MOST_CELLS else None


@functools.lru_cache(maxsize=64)
def _gamma(world: Mdp, evaluation_gamma: float, candidates: tuple[float, ...]) -> float:
    from gridworld.world.recommendation import clearest_gamma as clearest

    return clearest(world, candidates, evaluation_gamma)
