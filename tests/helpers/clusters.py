"""A Slurm of one node and a Ray head, for the tests that need one; they are skipped where there is none.

Debian's packages slurm-wlm and munge bring Slurm. No systemd is needed, and nothing of what is installed is
configured: all its files lie in a folder of the test's.
"""

import importlib.util
import os
import secrets
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from helpers.support import wait_for

_DAEMONS = ("munged", "slurmctld", "slurmd")
_CONFIGURATION = """
ClusterName=test
SlurmUser=root
SlurmdUser=root
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
MaxArraySize=101
SlurmdParameters=config_overrides
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=8000
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


@contextmanager
def slurm(folder: Path, variables: dict[str, str]) -> Iterator[dict[str, str]]:
    """The variables of the environment by which its commands find it."""
    search = os.environ["PATH"] + f"{os.pathsep}/usr/sbin"
    missing = [name for name in (*_DAEMONS, "sbatch") if shutil.which(name, path=search) is None]
    if os.geteuid() != 0:
        missing.append("root's rights")
    if missing and not os.environ.get("GRIDWORLD_REQUIRE_SLURM"):
        pytest.skip(f"no Slurm to test with: {', '.join(missing)} (Debian: slurm-wlm, munge)")
    folder.chmod(0o755)
    key = folder / "munge.key"
    key.write_bytes(secrets.token_bytes(128))
    key.chmod(0o400)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    host = socket.gethostname().partition(".")[0]
    settings = folder / "slurm.conf"
    settings.write_text(_CONFIGURATION.format(host=host, folder=folder, ports=_free_ports(2)))
    environment = {"SLURM_CONF": str(settings)}
    munge = {option: folder / f"munge.{option}" for option in ("socket", "pid", "log", "seed")}
    commands = (
        [
            *("munged", "--foreground", "--force", f"--key-file={key}", f"--socket={munge['socket']}"),
            *(f"--pid-file={munge['pid']}", f"--log-file={munge['log']}", f"--seed-file={munge['seed']}"),
        ],
        ["slurmctld", "-D", "-i"],
        ["slurmd", "-D", "-N", host],
    )
    with ExitStack() as daemons:
        for command in commands:
            daemons.enter_context(
                _daemon(command, folder, {**os.environ, **environment, **variables, "PATH": search})
            )
            if command[0] == "munged":
                wait_for(munge["socket"].exists, "munged's socket")

        def node_is_idle() -> bool:
            states = ["sinfo", "--noheader", "--format=%T"]
            answer = subprocess.run(states, env={**os.environ, **environment}, capture_output=True, text=True)
            return answer.stdout.strip() == "idle"

        wait_for(node_is_idle, f"a node of Slurm; its logs are in {folder}")
        yield environment


@contextmanager
def ray_head(folder: Path, variables: dict[str, str]) -> Iterator[dict[str, str]]:
    """The variables of the environment by which a program finds it. Its workers get `variables`."""
    if importlib.util.find_spec("ray") is None and not os.environ.get("GRIDWORLD_REQUIRE_RAY"):
        pytest.skip("no Ray to test with: pip install -e '.[ray]'")
    port, *_ = _free_ports(1)
    token = folder / "token"  # its own, whatever the user has in the home folder
    token.write_text(secrets.token_hex(32))
    token.chmod(0o600)
    access = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token)}
    quiet = {"RAY_USAGE_STATS_ENABLED": "0", **access}
    # `ray start` without --block would leave its daemons to whoever takes orphans.
    head = [
        *(str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", "--num-cpus=2"),
        *(f"--port={port}", "--node-ip-address=127.0.0.1", "--include-dashboard=false"),
        *("--object-store-memory=80000000", "--disable-usage-stats", f"--temp-dir={folder}"),
        *("--no-monitor", "--include-log-monitor=false"),  # nobody asks what they find
    ]
    environment = {"RAY_ADDRESS": f"127.0.0.1:{port}", **quiet}
    warnings = {"PYTHONWARNINGS": "ignore"}
    with _daemon(head, folder, {**os.environ, **quiet, **warnings, **variables}) as process:
        wait_for(lambda: "--block" in (folder / "ray.out").read_text(), "Ray's head", process)
        yield environment


@contextmanager
def _daemon(
    command: list[str], folder: Path, environment: dict[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """In the foreground, and with all its children gone afterwards."""
    with (folder / f"{Path(command[0]).name}.out").open("wb") as output:
        process = subprocess.Popen(
            command, env=environment, stdout=output, stderr=output, start_new_session=True
        )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(timeout=180)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _free_ports(count: int) -> list[int]:
    with ExitStack() as sockets:
        taken = [sockets.enter_context(socket.socket()) for _ in range(count)]
        for one in taken:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in taken]
