"""A process that has imported everything and run no script; each of its forks runs one of the scripts.

    python warm_process.py FD OWNER

Whoever connects to the socket FD is served by a fork of its own: a request comes over the connection, and the
answer goes back over it; `helpers.forks` asks. The process ends with the process OWNER. A fork starts
with what a process of its own would start with: command line, folder, environment, paths, random numbers.
Four things differ: everything is imported already, Hydra has composed settings once and composes faster (and
a report's template is compiled), garbage is collected less often, and what Python and the libraries read of
the environment while they are loaded is that of the first request. And no line says that something takes
long, as on a busy machine it may; the table of a search is written more often, and Slurm is asked more often.
"""

import atexit
import contextlib
import gc
import importlib
import json
import os
import pkgutil
import resource
import runpy
import select
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable
from multiprocessing import process as multiprocessing_process
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle
from pathlib import Path
from typing import Any, NoReturn

import huge_pages
import numpy as np
import PIL.Image
import reserve
import torch
from composing import compose_quickly
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import gridworld
from gridworld.config.compose import compose
from gridworld.envs.rendering import import_pygame
from gridworld.process import console
from gridworld.process.memory_budget import collect_less_often
from gridworld.report import page
from gridworld.tune import search as tune_search

CONF = Path(__file__).resolve().parents[2] / "conf"

# Words of each form, from which Hydra's parsers learn the grammar.
_WORDS = (
    *("agent=dqn", "seed=0,1", "seed=range(3)", "a=choice(1,2)", "hydra/launcher=joblib", "a=b/c-d_e.f"),
    *("a=true", "a=1e-3", "+a.b=-1.5", "++a={a: 1, b: null}", "~a.b", "a@b.c=d", "a=[64,64]", "a=${b.c}"),
    *("a='my map.txt'", 'a="b c"'),
)

# What is imported only once it is needed.
_LATE = (
    *("sb3_contrib", "torch.utils.tensorboard", "torch.utils.serialization", "torch._dynamo", "av"),
    *("optuna.storages._rdb.storage", "optuna.storages._rdb.models", "sqlalchemy.orm"),
    *("sqlalchemy.dialects.sqlite.pysqlite", "alembic.command", "alembic.config", "alembic.migration"),
    "optuna.importance._fanova",
    *("hydra._internal.hydra", "hydra._internal.logging_config", "hydra.core.plugins", "encodings.cp437"),
    *("matplotlib.backends.backend_svg", "matplotlib.backends.backend_pdf", "fontTools.subset"),
)
_NOT_FOR_FORKS = ".launchers.ray"  # Ray has threads as soon as it is imported
_IN_RESERVE = 6  # two workers, multiprocessing's watch over resources, and some for workers that are killed
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


def _import_everything() -> None:
    ours = (module.name for module in pkgutil.walk_packages(gridworld.__path__, "gridworld."))
    import_pygame()
    for name in (*ours, *_LATE):
        if not name.endswith(_NOT_FOR_FORKS):
            with contextlib.suppress(ModuleNotFoundError):  # an extra that is not installed
                importlib.import_module(name)
    PIL.Image.init()  # its file formats


def _wait_less_for_slurm() -> None:
    """It runs on this machine: it may be asked more often, and files are not late."""
    if launcher := sys.modules.get("gridworld.sweep.launchers.slurm"):  # an extra
        vars(launcher).update(_POLL_SECONDS=0.2, _SECONDS_BETWEEN_QUESTIONS=1.0, _FILES_ARRIVE_WITHIN=1.0)


def _end_without_finalizers() -> None:
    """Drop what the imported modules do at the end, for torch half of a short script's time."""
    for finalizer in list(weakref.finalize._registry):  # type: ignore[attr-defined]
        finalizer.atexit = False


def _listen(listener: socket.socket, owner: int) -> None:
    """Serve each connection in a fork, until the owner ends."""
    folder = os.path.dirname(listener.getsockname())
    ended = os.pidfd_open(owner)
    while ended not in select.select([listener, ended], [], [])[0]:
        connection, _ = listener.accept()
        if os.fork() == 0:
            os.close(ended)
            listener.close()
            _serve(Connection(connection.detach()))
            os._exit(0)
        connection.close()
    shutil.rmtree(folder, ignore_errors=True)


def _serve(connection: "Connection[Any, Any]") -> None:
    connection.send(os.getpid())
    while True:
        try:
            request = connection.recv()
        except EOFError:
            return
        if "reap" in request:
            connection.send(_reap(request["reap"], request["within"]))
            continue
        streams = recv_handle(connection), recv_handle(connection)
        child = os.fork()
        if child == 0:
            connection.close()
            _run(**request, streams=streams)
        for stream in streams:
            os.close(stream)
        connection.send(child)


def _reap(child: int, within: float | None) -> tuple[int | None, float]:
    """A fork's exit code and the seconds that it took to end; it is killed after `within`, None is never."""
    started = time.monotonic()
    ended = os.pidfd_open(child)
    is_over = select.select([ended], [], [], within or 0.0)[0]
    os.close(ended)
    if not is_over:
        if within is None:
            return None, 0.0
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status), time.monotonic() - started


def _run(
    script: str,
    words: list[str],
    cwd: str,
    environment: dict[str, str],
    watched: dict[str, str] | None,
    session: bool,
    streams: tuple[int, int],
) -> NoReturn:
    for number, file in enumerate(streams, start=1):
        os.dup2(file, number)
        os.close(file)
    if session:
        os.setsid()
    if any(word.endswith("launcher=joblib") for word in words):
        reserve.keep(_IN_RESERVE, _run_as)

    def program() -> None:
        if watched is not None:
            _watch(cwd, **watched)
        runpy.run_path(script, run_name="__main__")

    _run_as([script, *words], cwd, environment, program)


def _run_as(
    words: list[str], cwd: str, environment: dict[str, str], program: Callable[[], object]
) -> NoReturn:
    os.chdir(cwd)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever started the warm process
    os.environ.clear()
    os.environ.update(environment)
    paths = [path for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:1] = [os.path.dirname(words[0]), *paths]
    sys.argv = words
    np.random.seed()  # `random` sees to it itself
    torch.default_generator.seed()
    if threads := environment.get("OMP_NUM_THREADS"):
        torch.set_num_threads(int(threads))
    tempfile.tempdir = None
    multiprocessing_process.ORIGINAL_DIR = cwd  # type: ignore[attr-defined]
    _end(_exit_code(program))


def _exit_code(program: Callable[[], object]) -> int:
    try:
        program()
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            return end.code or 0
        print(end.code, file=sys.stderr)
        return 1
    except BaseException:
        sys.excepthook(*sys.exc_info())
        return 1
    return 0


def _end(code: int) -> NoReturn:
    """As Python does it, without taking every module apart."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        if not stream.closed:
            stream.flush()
    os._exit(code)


def _watch(cwd: str, secret: str, report: str) -> None:
    """Write down what nobody may do to a reader of data, and at the end the memory that the process took."""
    sys.dont_write_bytecode = True
    allowed = (os.path.realpath(cwd), os.path.realpath(tempfile.gettempdir()))
    deeds: list[str] = []
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    before = _megabytes("VmRSS")
    file = os.open(report, os.O_WRONLY)
    atexit.register(
        lambda: os.write(
            file, json.dumps({"megabytes": _megabytes("VmHWM") - before, "deeds": deeds}).encode()
        )
    )

    def is_outside(path: Any) -> bool:
        real = os.path.realpath(os.fsdecode(path))
        return real != os.devnull and not real.startswith(allowed)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in ("pickle.find_class", "os.system", "os.exec", "os.posix_spawn"):
            deeds.append(f"{event} {arguments}"[:300])
        elif event == "subprocess.Popen" and arguments[0] not in ("git", "uname"):
            deeds.append(f"{event} {arguments[0]}")
        elif event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            path, _, flags = arguments
            followed = not (flags and flags & os.O_NOFOLLOW)
            if followed and os.path.realpath(os.fsdecode(path)).startswith(os.path.realpath(secret)):
                deeds.append(f"opened {path!r}")
            if flags and flags & _WRITES and is_outside(path):
                deeds.append(f"wrote {path!r}")
        elif event in ("os.mkdir", "os.remove", "os.rmdir", "os.rename", "os.symlink", "os.link", "os.chmod"):
            ends = [end for end in arguments[:2] if isinstance(end, str | bytes)]
            # What is renamed or removed is the link itself, so only the folder that it is in counts.
            if any(is_outside(os.path.dirname(os.path.abspath(os.fsdecode(end)))) for end in ends):
                deeds.append(f"{event} {arguments}"[:300])

    sys.addaudithook(hook)


def _megabytes(field: str) -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.split(f"{field}:")[1].split()[0]) / 1024


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    gc.disable()
    _import_everything()
    console._SECONDS_BETWEEN_LINES = 600.0
    tune_search._SECONDS_BETWEEN_TABLES = 0.3
    _wait_less_for_slurm()
    compose_quickly()
    compose(CONF, [])
    for file in CONF.rglob("*.yaml"):
        with file.open(encoding="utf-8") as opened:
            OmegaConf.load(opened)  # which `compose_quickly` keeps
    OverridesParser.create().parse_overrides(list(_WORDS))
    page.template()
    _end_without_finalizers()
    gc.freeze()  # so that a fork shares what is there
    huge_pages.collapse()
    collect_less_often()
    gc.enable()
    listener = socket.socket(fileno=int(sys.argv[1]))
    listener.set_inheritable(False)
    _listen(listener, int(sys.argv[2]))
