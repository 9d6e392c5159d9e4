"""What is checked, and with which arguments and how long it trains on the probes.

They are chosen so that what fails is a bug: training goes on longer than SB3's own classes need, and the
learning rate falls to 0, so that values come to rest well within the tolerance. The kind of an algorithm
shows in the names of its arguments. It gets those of the kind's that it takes, and keeps its other defaults.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gridworld.agents.sb3.settings.schemas import SB3ClassConfig, SB3Config
from gridworld.checking.probes import Probe
from gridworld.config.agents import AgentConfig
from gridworld.errors import InputError

_OURS = {"gamma": "each probe has its own", "seed": "see --seed", "device": "it is cpu"}
_ENVS = 8
_FEW_QUANTILES = {"n_quantiles": 25}  # of a policy that has them; 200 take ten times as long


@dataclass(frozen=True)
class Kind:
    """Algorithms that are trained alike."""

    sign: str  # an argument by which the kind is known
    steps: int  # environment steps of a training run
    arguments: Mapping[str, Any]  # of the algorithm, by SB3's names
    num_envs: int = _ENVS  # that step together


_EXPLORING = {"exploration_fraction": 0.5, "exploration_initial_eps": 1.0, "exploration_final_eps": 0.05}
KINDS = (  # the first that fits
    Kind(  # DQN, QR-DQN
        "buffer_size",
        6400,
        {
            **_EXPLORING,
            "learning_rate": "lin_0.003",
            "buffer_size": 10_000,
            "learning_starts": 400,
            "batch_size": 128,
            "train_freq": 1,
            "gradient_steps": 1,
            "target_update_interval": 80,
        },
    ),
    Kind(  # TRPO
        "cg_max_steps",
        20_480,
        {"learning_rate": "lin_0.003", "n_steps": 64, "batch_size": 128, "target_kl": 0.05},
    ),
    Kind(  # PPO
        "n_epochs",
        20_480,
        {"learning_rate": "lin_0.006", "n_steps": 32, "batch_size": 512, "n_epochs": 5, "ent_coef": 0.0},
        num_envs=32,
    ),
    Kind(  # A2C
        "n_steps", 25_600, {"learning_rate": "lin_0.006", "n_steps": 4, "ent_coef": 0.0}, num_envs=32
    ),
    Kind(  # tables
        "learning_rate_power",
        16_000,
        {**_EXPLORING, "learning_rate": 0.05, "learning_rate_power": 0.0, "initial_value": 0.0},
    ),
    Kind("", 20_000, {"learning_rate": 1e-3}),
)


def settings(config: AgentConfig, probe: Probe, given: Mapping[str, Any]) -> tuple[AgentConfig, Kind] | None:
    """The settings of an algorithm on a probe, whose own arguments go before the user's, and its kind.

    None where it does not take what the probe needs.
    """
    if isinstance(config, SB3ClassConfig):
        known = _arguments_of(_class_of(config))
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
    kind = next(each for each in KINDS if each.sign in known or not each.sign)
    wanted = {**kind.arguments, **_of_policy(config), "gamma": probe.gamma, **given, **probe.arguments}
    return _with(config, {name: value for name, value in wanted.items() if name in known}), kind


def _with(config: AgentConfig, arguments: Mapping[str, Any]) -> AgentConfig:
    if isinstance(config, SB3ClassConfig):
        policies = (name for name in _class_of(config).policy_aliases if name.startswith("Mlp"))
        policy = next(policies, config.policy)  # a class may have a name of its own for it
        return dataclasses.replace(config, policy=policy, arguments={**config.arguments, **arguments})
    for name, value in arguments.items():
        own = getattr(config, name)
        if isinstance(own, int) and type(value) is not type(own):
            raise InputError(f"--set {name}={value}: must be {type(own).__name__}")
    return dataclasses.replace(config, **arguments)


def _of_policy(config: AgentConfig) -> dict[str, Any]:
    if not isinstance(config, SB3ClassConfig):
        return {}
    policy = _class_of(config).policy_aliases.get(config.policy, object)
    return {"policy_kwargs": _FEW_QUANTILES} if "n_quantiles" in _arguments_of(policy) else {}


def _class_of(config: SB3ClassConfig) -> Any:
    # here, since it imports torch
    from gridworld.agents.sb3.settings.constructor_arguments import algorithm_class

    return algorithm_class("check", config.algorithm)


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


def subject(algorithm: Any) -> AgentConfig:
    """Name an implementation by its settings.

    It is a class with SB3's interface or its import path, which trains in its own loop, or the name of a
    shipped agent.
    """
    if inspect.isclass(algorithm):
        algorithm = f"{algorithm.__module__}.{algorithm.__qualname__}"
    name = str(algorithm)
    if "." in name:
        return SB3ClassConfig(name=name, algorithm=name, engine="stock")
    from gridworld.config.composition.compose import compose
    from gridworld.config.composition.conf_folder import conf_folder

    known = sorted(file.stem for file in (conf_folder() / "agent").glob("*.yaml"))
    if name not in known:
        raise InputError(
            f"check {name}: must be the import path of a class, e.g. my_package.MyPPO, or a shipped agent, "
            f"which are {', '.join(known)}"
        )
    return compose(conf_folder(), [f"agent={name}"]).agent


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
