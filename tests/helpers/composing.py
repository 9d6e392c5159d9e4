"""Composing in two thirds of the time: what Hydra and OmegaConf repeat is done once in a process."""

import copy
import functools
from collections.abc import Callable
from typing import Any

import yaml
from omegaconf import DictConfig, ListConfig, _utils, base, nodes

_load_yaml = yaml.load
_loaded: dict[str, Any] = {}  # by the text of a file
_NODES = (
    *(DictConfig, ListConfig, nodes.AnyNode, nodes.StringNode, nodes.IntegerNode, nodes.FloatNode),
    *(nodes.BooleanNode, nodes.EnumNode, nodes.PathNode, nodes.BytesNode),
)


@functools.cache
def compose_quickly() -> None:
    """From now on, in this process and its forks. What is composed is the same."""
    for kind in _NODES:
        kind.__deepcopy__ = _copied_node  # type: ignore[attr-defined, method-assign]
    base.Metadata.__deepcopy__ = _copied  # type: ignore[attr-defined]
    base.parse = functools.cache(base.parse)  # type: ignore[attr-defined]  # a tree is only read
    for name in ("is_attr_class", "is_dataclass"):
        setattr(_utils, name, _by_type(getattr(_utils, name)))
    yaml.load = _load


def _by_type(check: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """The same question, which is one of an object's type, asked once of each type."""
    answer = functools.cache(lambda kind: not issubclass(kind, base.Node) and check(kind))
    return lambda object_or_type: answer(
        object_or_type if isinstance(object_or_type, type) else type(object_or_type)
    )


def _copied_node(node: base.Node, memo: dict[int, Any]) -> base.Node:
    """A deep copy that keeps its parent: without the constructors, which check what was checked."""
    new = object.__new__(type(node))
    new.__dict__.update(node.__dict__)
    new.__dict__["_metadata"] = _copied(node._metadata, memo)
    new.__dict__["_flags_cache"] = None
    content = node.__dict__.get("_content")
    if isinstance(content, dict):
        new.__dict__["_content"] = {key: _child(value, new, memo) for key, value in content.items()}
    elif isinstance(content, list):
        new.__dict__["_content"] = [_child(value, new, memo) for value in content]
    return new


def _child(node: base.Node, parent: base.Node, memo: dict[int, Any]) -> base.Node:
    new: base.Node = type(node).__deepcopy__(node, memo)  # type: ignore[attr-defined]
    new.__dict__["_parent"] = parent
    return new


def _copied(metadata: base.Metadata, memo: dict[int, Any]) -> base.Metadata:
    """A deep copy: all that it holds are types and words, but for two dictionaries."""
    new = object.__new__(type(metadata))
    new.__dict__.update(metadata.__dict__)
    new.flags = copy.copy(metadata.flags)
    new.resolver_cache = copy.deepcopy(metadata.resolver_cache, memo)
    return new


def _load(stream: Any, Loader: Any) -> Any:  # noqa: N803
    if Loader.__module__ != "omegaconf._utils" or isinstance(stream, str):
        return _load_yaml(stream, Loader)
    text = stream.read()
    if text not in _loaded:
        stream.seek(0)  # it has the name that a mistake in it is told with
        _loaded[text] = _load_yaml(stream, Loader)
    return copy.deepcopy(_loaded[text])
