"""The fixture `gridworld_check` of pytest.

Installed, this file is `pytest_gridworld.py`: a session that does not use the fixture imports nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture
def gridworld_check() -> Callable[..., Any]:
    """`gridworld.check`, which fails the test with the table of probes, unless all pass."""

    def check(*given: Any, **named: Any) -> Any:
        __tracebackhide__ = True
        import gridworld

        result = gridworld.check(*given, **named)
        if not result.passed:
            pytest.fail(str(result), pytrace=False)
        return result

    return check
