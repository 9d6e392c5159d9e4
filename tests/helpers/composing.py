"""Composing in half the time: what Hydra and OmegaConf repeat is done once in a process."""

import copy
import functools
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf, _utils, base, nodes

_load_file = OmegaConf.load
_loaded: dict[str, DictConfig | ListConfig] = {}  # by the text of a file
_MISSING, _INTERPOLATION = _utils.ValueKind.MANDATORY_MISSING, _utils.ValueKind.INTERPOLATION
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
    base.parse = _utils.parse = functools.cache(base.parse)  # type: ignore[attr-defined]  # a tree is only read
    for name in ("is_attr_class", "is_dataclass"):
        setattr(_utils, name, _by_type(getattr(_utils, name)))
    _replace(_utils.get_value_kind, _kind)
    _replace(_utils._is_missing_value, lambda value: _kind(value) is _MISSING)
    _replace(_utils._is_interpolation, lambda value, **strict: _kind(value, **strict) is _INTERPOLATION)
    for container in (DictConfig, ListConfig):
        container._re_parent = _adopt_all  # type: ignore[method-assign]
        container._invalidate_flags_cache = _forget_flags  # type: ignore[method-assign]
    OmegaConf.load = staticmethod(_load)  # type: ignore[method-assign]


def _replace(function: Callable[..., Any], faster: Callable[..., Any]) -> None:
    """Wherever OmegaConf has imported it by its name."""
    for module in [module for name, module in sys.modules.items() if name.startswith("omegaconf")]:
        if getattr(module, function.__name__, None) is function:
            setattr(module, function.__name__, faster)


def _children(container: DictConfig | ListConfig) -> Iterable[base.Node]:
    content = container.__dict__["_content"]
    if isinstance(content, dict):
        return content.values()
    return content if isinstance(content, list) else ()


def _adopt_all(container: DictConfig | ListConfig) -> None:
    """What `_re_parent` does, without imports and questions on the way."""
    for child in _children(container):
        if child is not None:
            child._set_parent(container)
            if isinstance(child, base.Box):
                child._re_parent()


def _forget_flags(container: DictConfig | ListConfig) -> None:
    """What `_invalidate_flags_cache` does."""
    if container.__dict__["_flags_cache"] is not None:
        container.__dict__["_flags_cache"] = None
        for child in _children(container):
            child._invalidate_flags_cache()


@functools.cache
def _is_node(kind: type) -> bool:
    return issubclass(kind, base.Node)


def _kind(value: Any, strict_interpolation_validation: bool = False) -> _utils.ValueKind:
    """What `get_value_kind` says, which imports on each call, and asks abstract classes."""
    if _is_node(type(value)):
        value = value._value()
    if not isinstance(value, str):
        return _utils.ValueKind.VALUE
    if value == "???":
        return _MISSING
    is_one = _utils._is_interpolation_string(value, strict_interpolation_validation)
    return _INTERPOLATION if is_one else _utils.ValueKind.VALUE


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
    new.flags = None if metadata.flags is None else dict(metadata.flags)
    kept = metadata.resolver_cache
    new.resolver_cache = copy.deepcopy(kept, memo) if kept else defaultdict(dict)
    return new


def _load(file: Any) -> DictConfig | ListConfig:
    if not hasattr(file, "read"):
        return _load_file(file)
    text = file.read()
    if text not in _loaded:
        file.seek(0)  # it has the name that a mistake in it is told with
        _loaded[text] = _load_file(file)
    return copy.deepcopy(_loaded[text])
