"""What `helpers.forks` has its server import: everything that a script imports; and how a fork runs a script.

A fork starts with what a process of its own would start with: command line, folder, environment, paths,
random numbers. Four things differ: everything is imported already, Hydra has composed settings once and
composes faster (and a report's template is compiled), garbage is collected less often, and what Python and
the libraries read of the environment while they are loaded is that of the tests. And no line says that
something takes long, as on a busy machine it may; the table of a search is written more often, and Slurm is
asked more often.
"""

import atexit
import contextlib
import fcntl
import gc
import importlib
import json
import os
import pkgutil
import resource
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Callable
from multiprocessing import process, util
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import PIL.Image
import torch
from helpers.forks import megabytes
from helpers.quickly import compose_quickly
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import gridworld
from gridworld.base import console
from gridworld.config.compose import compose
from gridworld.envs.rendering import import_pygame
from gridworld.report import writer
from gridworld.sweeps.tune import search as tune_search

_CONF = Path(__file__).resolve().parents[2] / "conf"
_PATH: list[str] = json.loads(  # of a new process, without the folder of its program and PYTHONPATH
    subprocess.run(
        [sys.executable, "-c", "import json, sys; print(json.dumps(sys.path[1:]))"],
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        check=True,
        capture_output=True,
    ).stdout
)

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
    *("optuna.importance._fanova", "gridworld.report.agent_charts", "gridworld.report.setting_charts"),
    *("hydra._internal.hydra", "hydra._internal.logging_config", "hydra.core.plugins", "encodings.cp437"),
    *("matplotlib.backends.backend_svg", "matplotlib.backends.backend_pdf", "fontTools.subset"),
)
_MAIN = process.current_process()  # the server's; a fork's own where that could not import this
_NOT_FOR_FORKS = ".launchers.ray"  # Ray has threads as soon as it is imported
_IN_RESERVE = 5  # two workers, and some for workers that are killed
_FIRST = 700  # numbers of files that nobody has
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


def _prepare() -> None:
    """Import and compute what many scripts need."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    gc.disable()
    import_pygame()
    ours = (module.name for module in pkgutil.walk_packages(gridworld.__path__, "gridworld."))
    for name in (*ours, *_LATE):
        if not name.endswith(_NOT_FOR_FORKS):
            with contextlib.suppress(ModuleNotFoundError):  # an extra that is not installed
                importlib.import_module(name)
    PIL.Image.init()  # its file formats
    console._SECONDS_BETWEEN_LINES = 600.0
    tune_search._SECONDS_BETWEEN_TABLES = 0.3
    if launcher := sys.modules.get("gridworld.sweeps.launchers.slurm"):  # it runs here: files are not late
        vars(launcher).update(_SECONDS_BETWEEN_QUESTIONS=1.0, _FILES_ARRIVE_WITHIN=1.0)
    compose_quickly()
    compose([])
    for file in _CONF.rglob("*.yaml"):
        with file.open(encoding="utf-8") as opened:
            OmegaConf.load(opened)  # which `compose_quickly` keeps
    OverridesParser.create().parse_overrides(list(_WORDS))
    writer.template()
    for finalizer in list(weakref.finalize._registry):  # type: ignore[attr-defined]
        finalizer.atexit = False  # what imported modules do at the end, for torch half of a script's time
    gc.freeze()  # so that a fork shares what is there
    gc.set_threshold(50_000)
    gc.enable()


def run(words: list[str], cwd: str, environment: dict[str, str], watched: tuple[str, str] | None) -> NoReturn:
    """Run a script in this fork; `words` are its command line."""
    vars(process).update(_current_process=_MAIN, _parent_process=None)
    vars(_MAIN)["_config"]["daemon"] = False  # so that it may have children
    if any(word.endswith("launcher=joblib") for word in words):
        _keep_workers()

    def program() -> None:
        if watched is not None:
            _watch(cwd, *watched)
        runpy.run_path(words[0], run_name="__main__")

    _run_as(words, cwd, environment, program)


def _run_as(
    words: list[str], cwd: str, environment: dict[str, str], program: Callable[[], object]
) -> NoReturn:
    os.chdir(cwd)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever started the server
    os.environ.clear()
    os.environ.update(environment)
    added = [path for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:] = [os.path.dirname(words[0]), *added, *_PATH]
    sys.argv = words
    np.random.seed()  # `random` sees to it itself
    torch.default_generator.seed()
    if threads := environment.get("OMP_NUM_THREADS"):
        torch.set_num_threads(int(threads))
    tempfile.tempdir = None
    process.ORIGINAL_DIR = cwd  # type: ignore[attr-defined]
    code = _exit_code(program)
    threading._shutdown()  # type: ignore[attr-defined]  # and the rest of what Python does at its end
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        if not stream.closed:
            stream.flush()
    os._exit(code)


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


# ---- workers -----------------------------------------------------------------------------------------------


def _keep_workers() -> None:
    """Let forks wait for which multiprocessing would start Python anew: workers of a search or a sweep.

    They are forked before a script runs, so that they know no more of it than a Python that is started.
    Where they are used up, Python is started.
    """
    waiting, start_python = [_waiting_fork() for _ in range(_IN_RESERVE)], util.spawnv_passfds

    def start(path: bytes, words: list[str], files: tuple[int, ...]) -> int:
        if not waiting or "--multiprocessing-fork" not in words:
            return start_python(path, words, files)
        request = {
            "code": words[words.index("-c") + 1],
            "files": list(files),
            "cwd": os.getcwd(),
            "environment": dict(os.environ),
            "blocked": list(signal.pthread_sigmask(signal.SIG_BLOCK, [])),
            "ignored": [n for n in signal.valid_signals() if signal.getsignal(n) is signal.SIG_IGN],
        }
        child, end = waiting.pop(0)
        with end:
            socket.send_fds(end, [json.dumps(request).encode()], files)
        return child

    util.spawnv_passfds = start


def _waiting_fork() -> tuple[int, socket.socket]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        end = socket.socket(fileno=fcntl.fcntl(theirs.detach(), fcntl.F_DUPFD_CLOEXEC, _FIRST))
        os.closerange(3, _FIRST)
        content, files, _, _ = socket.recv_fds(end, 2**20, 64)
        if not content:
            os._exit(0)  # the script has ended
        end.close()
        _work(json.loads(content), files)
    theirs.close()
    return child, ours


def _work(request: dict[str, Any], files: list[int]) -> NoReturn:
    apart = [fcntl.fcntl(file, fcntl.F_DUPFD, _FIRST) for file in files]
    os.closerange(3, _FIRST)
    for file, number in zip(apart, request["files"], strict=True):
        os.dup2(file, number)
        os.close(file)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in request["ignored"]:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_SETMASK, request["blocked"])
    _run_as(
        ["-c", "--multiprocessing-fork"],
        request["cwd"],
        request["environment"],
        lambda: exec(request["code"], sys.modules["__main__"].__dict__),
    )


# ---- a script that is watched ------------------------------------------------------------------------------


def _watch(cwd: str, secret: str, report: str) -> None:
    """Write down what nobody may do to a reader of data, and at the end what the process took."""
    sys.dont_write_bytecode = True
    allowed = (os.path.realpath(cwd), os.path.realpath(tempfile.gettempdir()))
    deeds: list[str] = []
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    before, began = megabytes("VmRSS"), sum(os.times()[:4])
    file = os.open(report, os.O_WRONLY | os.O_CREAT)

    def report_what_it_took() -> None:
        took = {
            "megabytes": megabytes("VmHWM") - before,
            "seconds": sum(os.times()[:4]) - began,
            "deeds": deeds,
        }
        os.write(file, json.dumps(took).encode())

    atexit.register(report_what_it_took)

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


_prepare()
