"""The schemas that may stand in a section of a run's settings: any agent's, any source's of worlds."""

from __future__ import annotations

from gridworld.config.agents import AgentConfig, agent_schemas
from gridworld.config.worlds import SOURCES, EnvConfig


def alternatives(schema: type) -> tuple[type, ...]:
    """The schemas that may stand where a field is annotated with `schema`, itself first."""
    if schema is AgentConfig:
        return (schema, *agent_schemas().values())
    if schema is EnvConfig:
        return (schema, *SOURCES.values())
    return (schema,)
