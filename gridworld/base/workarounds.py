"""Private API of dependencies, and what is changed in them: all of it is in this file.

Each says what it gains, in seconds on two cores. Where a dependency is built otherwise, the gain is lost and
nothing else; `tests/test_workarounds.py` says then what has changed. Nothing is imported before it is needed.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # what type checkers take for True; `typing` itself would double the import's cost
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

_blas: list[tuple[Callable[[], int], Callable[[int], Any]]] = []  # once it was looked for


class _GymnasiumWatch:
    """Finds no module. Python asks it at each import, until Gymnasium's registry is there."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._call = call

    def find_spec(self, *module: object) -> None:
        # The registry's module imports nothing after it has defined this name.
        if hasattr(sys.modules.get("gymnasium.envs.registration"), "register"):
            sys.meta_path = [finder for finder in sys.meta_path if finder is not self]
            self._call()


def when_gymnasium_is_imported(call: Callable[[], None]) -> None:
    """Call a function now if Gymnasium is there already, else as soon as it is imported.

    `import gridworld` registers an environment in 2 ms; importing Gymnasium for that takes 0.2 s.
    """
    watch = _GymnasiumWatch(call)
    sys.meta_path.insert(0, watch)
    watch.find_spec()


def generator_of(thing: Any) -> Any:
    """The generator of one of Gymnasium's environments or spaces; None for one that has drawn nothing yet.

    Their property `np_random` would make one, which would be stored with the model, and differ each time.
    """
    return getattr(thing, "_np_random", None)


def blas_threads() -> tuple[Callable[[], int], Callable[[int], Any]]:
    """OpenBLAS's functions that get and set the number of its threads; another library is left as it is.

    With one thread a solution has the same bits on every machine of a kind; a call takes a microsecond.
    """
    if not _blas:
        import ctypes
        import itertools

        import numpy as np

        library: Any = ctypes.CDLL(np.linalg._umath_linalg.__file__)
        for prefix, suffix in itertools.product(("scipy_openblas", "openblas"), ("64_", "_64", "")):
            tell, limit = (f"{prefix}_{verb}_num_threads{suffix}" for verb in ("get", "set"))
            if hasattr(library, tell) and hasattr(library, limit):
                _blas.append((getattr(library, tell), getattr(library, limit)))
        _blas.append((lambda: 1, lambda threads: None))
    return _blas[0]


def let_hydra_parse() -> None:
    """Let Hydra 1.3 start on Python 3.14, whose argparse refuses a help that is turned into text later."""
    import argparse

    if hasattr(argparse.ArgumentParser, "_check_help"):
        argparse.ArgumentParser._check_help = lambda self, action: None


def keep_compiler_out() -> None:
    """Spare a run of the engine the import of torch's compiler: 2 s of the 6 s that a short one then takes.

    Optimisers import it as they are made, to exempt some methods from compilation, and with their first
    step, which such a run never makes. Nothing here is compiled, so the methods are marked beforehand.
    """
    import torch

    for name in ("add_param_group", "state_dict", "load_state_dict"):
        method = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dict__["__dynamo_disable"] = method
