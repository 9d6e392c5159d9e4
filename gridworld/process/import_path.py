"""Import paths in settings: `package.module.name` of something of the user's own."""

from __future__ import annotations

import importlib
from typing import Any

from gridworld.errors import InputError, install_command

_EXTRAS = {"sb3_contrib": ("sb3-contrib", "contrib")}  # of modules: the package, and what installs it


def imported(where: str, path: Any) -> Any:
    """Import what a path names.

    Args:
        where: the setting that has the path, for messages.
        path: the import path.

    Returns:
        It; None where its module has nothing of that name, or the path is none.

    Raises:
        InputError: there is no such module, or it cannot be imported.
    """
    module, _, name = str(path).rpartition(".")
    try:
        return getattr(importlib.import_module(module), name, None)
    except ModuleNotFoundError as error:
        if error.name in _EXTRAS:
            package, extra = _EXTRAS[error.name]
            raise InputError(f"{where}={path}: needs {package}; {install_command(extra)}") from None
        if error.name and f"{module}.".startswith(f"{error.name}."):
            raise InputError(
                f"{where}={path}: there is no module {error.name}; is the folder that it is in on PYTHONPATH?"
            ) from None
        raise InputError(f"{where}={path}: {module} needs {error.name}, which is not installed") from None
    except (ValueError, TypeError):  # no path at all
        return None
    except Exception as error:  # a module of the user's own may raise anything
        told = f"{module} cannot be imported ({type(error).__name__}: {error})"
        raise InputError(f"{where}={path}: {told}") from error
