"""A finished run, opened again: its settings, its world and its trained agent.

A run's folder is data. Its settings are JSON, checked field by field against the schema, and its weights
are read as tensors; nothing in it is unpickled, imported by name without a check, or run.
"""

from __future__ import annotations

import dataclasses
import types
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from gridworld.agents import Beliefs, family
from gridworld.chain import one_hot_policy
from gridworld.config import AGENT_SCHEMAS, AgentConfig, SB3ClassConfig, TrainConfig, check
from gridworld.errors import InputError
from gridworld.evaluation import Judge
from gridworld.layout import CLASSIC, Layout, load, parse
from gridworld.mdp import FloatArray, Mdp
from gridworld.observations import make_observation
from gridworld.run import Run, open_run
from gridworld.training import make_mdp, make_seat

_LIBRARIES = ("torch.nn.", "torch.optim.", "stable_baselines3.", "sb3_contrib.")


class SavedRun:
    """A finished run. Raises `InputError` where the folder holds none, or not all of one.

    `trust` lets it import classes that are neither ours nor one of the libraries'.
    """

    def __init__(self, folder: Path, trust: bool = False) -> None:
        self.run: Run = open_run(folder)
        manifest = self.run.manifest
        self.config = read_config(manifest["config"], str(self.run.manifest_file))
        self.config.device = "cpu"  # where it was trained is no reason to need the same machine
        check(self.config)
        if not trust:
            _check_imports(dataclasses.asdict(self.config.agent), str(self.run.manifest_file))
        family(self.config.agent).check(self.config)
        self.mdp: Mdp = make_mdp(self.config.env, self._trained_layout(manifest["layout"]))

    def _trained_layout(self, lines: Any) -> Layout:
        if not (isinstance(lines, list) and all(isinstance(line, str) for line in lines)):
            raise InputError(f"{self.run.manifest_file}: layout must be a list of the map's rows")
        return dataclasses.replace(
            parse("\n".join(lines), f"{self.run.manifest_file}: layout"), name=self.config.env.layout
        )

    def judge(self, layout: str | None = None) -> Judge:
        """The judge of its own world, or of another map of the same size."""
        mdp = self.mdp
        if layout is not None:
            trained = mdp.layout
            world = load(layout, *_size(trained)) if layout == CLASSIC else load(layout)
            if _size(world) != _size(trained):
                raise InputError(
                    f"layout {world.name}: is {world.num_rows}x{world.num_cols}, the agent was trained on "
                    f"{trained.num_rows}x{trained.num_cols}; take a map of that size"
                )
            mdp = make_mdp(self.config.env, world)
        return Judge(mdp, self.config.evaluation.gamma, self.config.env.max_episode_steps)

    def beliefs(self) -> Beliefs:
        """What the trained agent believes of every state."""
        observation = make_observation(
            self.mdp, self.config.observation.kind, self.config.observation.cell_size
        )
        agent = family(self.config.agent).build(
            self.config.agent, make_seat(self.config, self.mdp, observation)
        )
        agent.load(self.run.model_file)
        return agent.beliefs()


def _check_imports(agent: dict[str, Any], where: str) -> None:
    """Refuse an import path that leads out of the libraries an agent is made of."""
    for key, value in agent.items():
        if isinstance(value, dict):
            _check_imports(value, where)
        elif _is_foreign(key, value):
            raise InputError(
                f"{where}: {key}={value} is from none of {', '.join(_LIBRARIES)}; add --trust to import it "
                "all the same, if you trust whoever made this run"
            )


def _is_foreign(key: str, value: Any) -> bool:
    names_a_class = key.endswith(("_class", "_fn")) or key in ("algorithm", "policy")
    return names_a_class and isinstance(value, str) and "." in value and not value.startswith(_LIBRARIES)


def choose_policy(beliefs: Beliefs, kind: str) -> FloatArray:
    """The table (S, A) of the greedy or of the sampled policy."""
    return one_hot_policy(beliefs.greedy) if kind == "greedy" else beliefs.sampled


def read_config(content: Any, where: str) -> TrainConfig:
    """Settings from a manifest's JSON. Raises `InputError` for anything that the schema does not have."""
    agent = content.get("agent") if isinstance(content, dict) else None
    agent = agent if isinstance(agent, dict) else {}
    algorithm, any_class = agent.get("algorithm"), SB3ClassConfig if "arguments" in agent else None
    schema = next((s for s in AGENT_SCHEMAS.values() if s.algorithm == algorithm), any_class)
    if schema is None:
        raise InputError(f"{where}: config.agent.algorithm={algorithm!r} is not known here")
    config = _read(TrainConfig, content, f"{where}: config", {AgentConfig: schema})
    assert isinstance(config, TrainConfig)
    return config


def _read(schema: type, content: Any, where: str, stand_in: dict[type, type]) -> object:
    hints = get_type_hints(schema)
    if not isinstance(content, dict) or content.keys() != hints.keys():
        found = sorted(content) if isinstance(content, dict) else type(content).__name__
        raise InputError(f"{where}: must have the keys {sorted(hints)}, has {found}")
    values = {}
    for name, hint in hints.items():
        kind, value = stand_in.get(hint, hint), content[name]
        if dataclasses.is_dataclass(kind):
            assert isinstance(kind, type)
            values[name] = _read(kind, value, f"{where}.{name}", stand_in)
        elif _fits(value, kind):
            values[name] = value
        else:
            raise InputError(f"{where}.{name}={value!r}: must be {getattr(kind, '__name__', kind)}")
    return schema(**values)


def _fits(value: Any, hint: Any) -> bool:
    if hint is Any:
        return True
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, choice) for choice in get_args(hint))
    kind = origin or hint
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, (int, float) if kind is float else kind)


def _size(layout: Layout) -> tuple[int, int]:
    return layout.num_rows, layout.num_cols
