"""Interpolations such as `${times:4,${n_envs}}`, which OmegaConf parses anew whenever a setting is read.

A run's settings are read a few times, a sweep's for each of its jobs, from the same few texts; parsing them
took most of the time of turning composed settings into dataclasses. What a text is parsed to does not
change, so it is kept. This builds on internals of OmegaConf, which tests/config/test_interpolations.py
checks.
"""

from __future__ import annotations

import functools
from typing import Any

import omegaconf._utils
import omegaconf.base
from omegaconf import grammar_parser

_MOST_TEXTS, _LONGEST = 256, 400  # of n characters about n / 2 kilobytes are kept


def parse_each_text_once() -> None:
    """Have OmegaConf keep what it parsed, in the whole process."""
    users: tuple[Any, ...] = omegaconf.base, omegaconf._utils
    for module in users:
        module.parse = _parse


def _parse(value: str) -> Any:
    return _kept(value) if len(value) <= _LONGEST else grammar_parser.parse(value)


@functools.lru_cache(maxsize=_MOST_TEXTS)
def _kept(value: str) -> Any:
    return grammar_parser.parse(value)
