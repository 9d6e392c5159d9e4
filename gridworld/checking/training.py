"""Training an implementation on a probe's world: with which settings, how long, and what is seen of it.

They are chosen so that what fails is a bug: training goes on longer than SB3's own classes need, and the
learning rate falls to 0, so that values come to rest well within the tolerance. The kind of an algorithm
shows in the names of its arguments. It gets those of the kind's that it takes, and keeps its other defaults.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import Agent, TrainingContext
from gridworld.agents.sb3.settings import SB3ClassConfig, SB3Config
from gridworld.base.errors import InputError
from gridworld.base.user_input import named_object
from gridworld.checking.function import OBSERVATIONS, FunctionConfig
from gridworld.checking.probes import Probe, Trained
from gridworld.config.train import AgentConfig
from gridworld.envs.observations import make_observation
from gridworld.envs.training_env import TrainingVectorEnv
from gridworld.world.chain import one_hot_policy
from gridworld.world.mdp import Mdp

_LAST = 0.6  # of training; what it does after that is its behaviour
_OURS = {"gamma": "each probe sets its own", "seed": "see --seed", "device": "it is always cpu"}
_FEW_QUANTILES = {"n_quantiles": 25}  # of a policy that has them; 200 take ten times as long


@dataclass(frozen=True)
class Kind:
    """Algorithms that are trained alike."""

    sign: str  # an argument by which the kind is known
    steps: int  # environment steps of a training run
    num_envs: int  # that step together
    arguments: Mapping[str, Any]  # of the algorithm, by SB3's names


_EXPLORING = {"exploration_fraction": 0.5, "exploration_initial_eps": 1.0, "exploration_final_eps": 0.05}
_REPLAY = {"buffer_size": 10_000, "learning_starts": 400, "batch_size": 128, "train_freq": 1}
# fmt: off
KINDS = (  # the first that fits: DQN and QR-DQN, TRPO, PPO, A2C, tables, others
    Kind("buffer_size", 6400, 8, {**_EXPLORING, **_REPLAY, "learning_rate": "lin_0.003", "gradient_steps": 1,
                                  "target_update_interval": 80}),
    Kind("cg_max_steps", 20_480, 8, {"learning_rate": "lin_0.003", "n_steps": 64, "batch_size": 128,
                                     "target_kl": 0.05}),
    Kind("n_epochs", 20_480, 32, {"learning_rate": "lin_0.006", "n_steps": 32, "batch_size": 512,
                                  "n_epochs": 5, "ent_coef": 0.0}),
    Kind("n_steps", 25_600, 32, {"learning_rate": "lin_0.006", "n_steps": 4, "ent_coef": 0.0}),
    Kind("learning_rate_power", 16_000, 8, {**_EXPLORING, "learning_rate": 0.05, "learning_rate_power": 0.0,
                                            "initial_value": 0.0}),
    Kind("", 20_000, 8, {"learning_rate": 1e-3}),
)
FUNCTION = Kind("", 20_000, 1, {})  # it chooses its arguments itself
# fmt: on


def settings(config: AgentConfig, probe: Probe, given: Mapping[str, Any]) -> tuple[AgentConfig, Kind] | None:
    """The settings of an algorithm on a probe, and its kind; None: it does not take what the probe needs."""
    algorithm: Any = None
    if isinstance(config, SB3ClassConfig):
        from gridworld.agents.sb3.factory import import_class  # imports torch

        algorithm = import_class("check", config.algorithm)
        known = _arguments_of(algorithm)
    elif isinstance(config, FunctionConfig):
        known = config.known
    else:
        general = {field.name for field in dataclasses.fields(SB3Config)}
        known = sorted({field.name for field in dataclasses.fields(config)} - general)
    for name in given:
        if name in _OURS:
            raise InputError(f"--set {name}: {_OURS[name]}; leave it out")
        if name not in known:
            raise InputError(f"--set {name}: {config.name} has no such argument; it has {', '.join(known)}")
    if probe.needs and probe.needs not in known:
        return None
    if isinstance(config, FunctionConfig):
        wanted = {"gamma": probe.gamma, **given, **probe.arguments}
        chosen = {name: wanted[name] for name in wanted if name in known}
        return dataclasses.replace(config, arguments=chosen), FUNCTION
    kind = next(each for each in KINDS if each.sign in known or not each.sign)
    wanted = {**kind.arguments, "gamma": probe.gamma, **given, **probe.arguments}
    if isinstance(config, SB3ClassConfig):
        policies = algorithm.policy_aliases
        if "n_quantiles" in _arguments_of(policies.get(config.policy, object)):
            wanted = {"policy_kwargs": _FEW_QUANTILES, **wanted}
        chosen = {**config.arguments, **{name: wanted[name] for name in wanted if name in known}}
        # A class may have a name of its own for the policy.
        policy = next((name for name in policies if name.startswith("Mlp")), config.policy)
        return dataclasses.replace(config, policy=policy, arguments=chosen), kind
    chosen = {name: wanted[name] for name in wanted if name in known}
    for name, value in chosen.items():
        own = getattr(config, name)
        if isinstance(own, int) and type(value) is not type(own):
            raise InputError(f"--set {name}={value}: must be {type(own).__name__}")
    return dataclasses.replace(config, **chosen), kind


def _arguments_of(kind: type) -> list[str]:
    """Names of its constructor's arguments; one with **kwargs takes those of its base class."""
    names: set[str] = set()
    for each in kind.__mro__:
        if "__init__" not in vars(each):
            continue
        parameters = inspect.signature(each).parameters.values()
        kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        names |= {parameter.name for parameter in parameters if parameter.kind in kinds}
        if all(parameter.kind is not parameter.VAR_KEYWORD for parameter in parameters):
            break
    return sorted(name for name in names - {"policy", "env"} if not name.startswith("_"))


def subject(algorithm: Any, observation: str = "state") -> AgentConfig:
    """The settings of a train function, a class with SB3's interface or a shipped agent, also by name."""
    if isinstance(algorithm, str) and re.search(r":|\.py$", algorithm):
        found = named_object(f"check {algorithm}", algorithm)
        if not callable(found):
            raise InputError(f"check {algorithm}: must be a function, as module:function")
        if not inspect.isclass(found):
            return dataclasses.replace(subject(found, observation), name=algorithm)
    if observation not in OBSERVATIONS:
        raise InputError(f"observation={observation!r}: must be {' or '.join(OBSERVATIONS)}")
    if callable(algorithm) and not inspect.isclass(algorithm):
        name = getattr(algorithm, "__name__", type(algorithm).__name__)
        return FunctionConfig(name=name, algorithm=name, train=algorithm, observation=observation)
    if observation != "state":
        raise InputError(f"observation={observation}: is for a train function; leave it out")
    if inspect.isclass(algorithm):
        algorithm = f"{algorithm.__module__}.{algorithm.__qualname__}"
    name = str(algorithm)
    if re.search("[.:]", name):
        return SB3ClassConfig(name=name, algorithm=name, engine="stock")
    from gridworld.config.compose import compose
    from gridworld.config.messages import meant
    from gridworld.config.words import conf_folder

    known = sorted(file.stem for file in (conf_folder() / "agent").glob("*.yaml"))
    if name not in known:
        raise InputError(
            f"check {name}: must be a train function, e.g. my_agent:train, the import path of a class, e.g. "
            f"my_package.MyPPO, or a shipped agent{meant(name, known) or ', which are ' + ', '.join(known)}"
        )
    return compose([f"agent={name}"]).agent


def arguments(words: Sequence[str]) -> dict[str, Any]:
    """The arguments of `--set NAME=VALUE`; values are Python's, or text."""
    found: dict[str, Any] = {}
    plain = {"true": True, "false": False, "null": None}
    for word in words:
        name, equals, value = word.partition("=")
        if not (name.isidentifier() and equals and value):
            raise InputError(f"--set {word}: must be NAME=VALUE, e.g. learning_rate=0.001")
        try:
            found[name] = plain[value] if value in plain else ast.literal_eval(value)
        except (ValueError, SyntaxError):
            found[name] = value
    return found


def build(config: AgentConfig, mdp: Mdp, num_envs: int, seed: int) -> tuple[Agent, TrainingContext]:
    """Build an agent on a world."""
    kind = "none" if config.family == "tabular" else "one_hot"
    if isinstance(config, FunctionConfig):
        kind = OBSERVATIONS[config.observation]
    envs = TrainingVectorEnv(num_envs, mdp=mdp, max_episode_steps=mdp.max_episode_steps)
    context = TrainingContext(envs, make_observation(mdp, kind), seed, "cpu")
    return config.build(context), context


def train(config: AgentConfig, mdp: Mdp, gamma: float, num_envs: int, steps: int, seed: int) -> Trained:
    """Train an agent, with the loop of its own library; raises whatever the implementation raises."""
    agent, context = build(config, mdp, num_envs, seed)
    first, before = agent.snapshot(), _parameters(agent)
    earlier = np.zeros_like(context.envs.visits)

    def watch(step: int) -> int:
        if step <= _LAST * steps:
            earlier[...] = context.envs.visits
        return step + 1

    agent.learn(steps, watch)
    after = _parameters(agent)
    frozen = [name for name, table in before.items() if name in after and np.array_equal(table, after[name])]
    visits = context.envs.visits.copy()
    greedy, predict = agent.snapshot().greedy_policy(), getattr(agent.model, "predict", None)
    if predict is not None:  # a table has none
        actions, _ = predict(context.observation.table(), deterministic=True)
        greedy = one_hot_policy(np.asarray(actions).astype(np.int64), mdp.num_actions)
    unknown = {**({} if before else {"parameters": "has no layers"}), **getattr(agent, "unknown", {})}
    return Trained(mdp, gamma, first, agent.snapshot(), greedy, visits, visits - earlier, frozen, unknown)


def _parameters(agent: Agent) -> dict[str, NDArray[Any]]:
    policy = getattr(agent.model, "policy", None)
    named = policy.named_parameters() if policy is not None else ()
    return {name: value.detach().cpu().numpy().copy() for name, value in named}
