"""A notebook's process: it runs the cells that it is sent, and calls their functions.

`work` starts this file as a script; every request and every reply is a line of JSON.
"""

import ast
import json
import numbers
import os
import re
import resource
import socket
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

_CPU_SECONDS = 3600  # of what a notebook leaves behind


class _MissingError(Exception):
    """The notebook does not define what is asked for."""


def main() -> None:
    """Answer requests until there are no more."""
    for what, most in ((resource.RLIMIT_AS, int(sys.argv[1])), (resource.RLIMIT_CPU, _CPU_SECONDS)):
        hard = resource.getrlimit(what)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (most, most))
    with socket.socket(fileno=os.dup(0)) as connection, connection.makefile("rwb") as lines:
        os.dup2(1, 0)
        notebook = sys.modules["__main__"] = ModuleType("__main__")
        vars(notebook)["display"] = print  # as in Jupyter
        for line in lines:
            request = json.loads(line)
            try:
                reply = {"result": _answer(vars(notebook), request)}
                json.dumps(reply)  # which fails for what is not plain
            except NotImplementedError:
                reply = {"error": "is not done yet"}
            except _MissingError:
                reply = {"error": "is not in the notebook"}
            except BaseException as error:
                reply = {"error": f"raised {type(error).__name__}: {error}"[:300]}
            lines.write(json.dumps({"number": request["number"], **reply}).encode() + b"\n")
            lines.flush()


def _answer(names: dict[str, Any], request: dict[str, Any]) -> Any:
    if "cell" in request:
        source = request["source"]
        try:
            ast.parse(source)
        except SyntaxError:  # IPython's own lines
            source = re.sub(r"^(\s*)[%!].*$", r"\1pass", source, flags=re.MULTILINE)
        exec(compile(source, f"cell {request['cell']}", "exec"), names)
        return None
    if request["name"] not in names:
        raise _MissingError
    found = names[request["name"]]
    return _plain(found(*map(_argument, request["arguments"])) if "arguments" in request else found)


def _argument(value: Any) -> Any:
    """What a function gets: an array of numpy; a world has its tables as attributes."""
    if not isinstance(value, dict):
        return value
    if "array" in value:
        import numpy as np

        return np.array(value["array"], dtype=value["type"])
    return SimpleNamespace(**{name: _argument(each) for name, each in value.items()})


def _plain(value: Any) -> Any:
    """Plain data of what a function returned."""
    if isinstance(value, numbers.Rational) and not isinstance(value, int):
        return float(value)
    if hasattr(value, "tolist"):  # an array, or a number of numpy's
        return value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    return [*map(_plain, value)] if isinstance(value, list | tuple | set) else value


if __name__ == "__main__":
    main()
