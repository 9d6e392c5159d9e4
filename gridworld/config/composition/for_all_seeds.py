"""Settings that differ in the seed only are converted once, for all of them."""

from __future__ import annotations

import contextlib
import contextvars
import pickle
from collections.abc import Callable, Hashable, Iterator
from dataclasses import replace

from omegaconf import DictConfig, OmegaConf

from gridworld.config.composition.compose import to_config
from gridworld.config.train import TrainConfig

_MOST = 64  # configurations that are kept
_DIFFERS = ("seed", "hydra")  # what an interpolation may name that is another for each seed


class ForAllSeeds:
    """Keeps configurations, to give them out with other seeds."""

    def __init__(self) -> None:
        self._kept: dict[Hashable, bytes] = {}  # so that no two share a dictionary

    def config(self, key: Hashable, seed: int, compose: Callable[[], DictConfig]) -> TrainConfig:
        """The configuration with a seed.

        Args:
            key: tells all that the settings follow from, without the seed.
            seed: the settings' own.
            compose: makes the settings; called where they are not known, or depend on the seed.

        Raises:
            InputError: as `to_config`, and whatever `compose` raises.
        """
        if (kept := self._kept.get(key)) is not None:
            config: TrainConfig = pickle.loads(kept)
            return replace(config, seed=seed)
        settings = compose()
        config = to_config(settings)
        if not any(name in text for text in _interpolations(_content(settings)) for name in _DIFFERS):
            if len(self._kept) >= _MOST:
                self._kept.clear()
            self._kept[key] = pickle.dumps(config)
        return config


_shared: contextvars.ContextVar[ForAllSeeds | None] = contextvars.ContextVar("shared", default=None)


@contextlib.contextmanager
def converting_once() -> Iterator[None]:
    """Within, `converted` does so once for all seeds."""
    token = _shared.set(ForAllSeeds())
    try:
        yield
    finally:
        _shared.reset(token)


def converted(settings: DictConfig) -> TrainConfig:
    """See `to_config`."""
    if (shared := _shared.get()) is None:
        return to_config(settings)
    content = _content(settings)
    seed = content.pop("seed", None)
    if type(seed) is not int:  # it follows from another setting
        return to_config(settings)
    return shared.config(repr(content), seed, lambda: settings)


def _content(settings: DictConfig) -> dict[object, object]:
    content = OmegaConf.to_container(settings, resolve=False)
    assert isinstance(content, dict)
    return dict(content)


def _interpolations(node: object) -> Iterator[str]:
    if isinstance(node, dict | list):
        for each in node.values() if isinstance(node, dict) else node:
            yield from _interpolations(each)
    elif isinstance(node, str) and "${" in node:
        yield node
