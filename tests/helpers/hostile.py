"""Run folders as somebody would make them who means harm, or does not care: a catalogue.

Each entry takes a good run's folder and spoils it. Whatever can be sealed again, is: checksums in a
stranger's manifest are the stranger's. `base` is the folder that the run is in; beside it are

    secret.txt, secret.json, secret.png   that no command may read, or tell of
    outside/     that no command may write to
    canary       a path that code out of a run would create
"""

import base64
import hashlib
import io
import json
import os
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gridworld.config.settings import read_config
from gridworld.process.user_input import npz_bytes
from gridworld.run.provenance import identity
from gridworld.storage.safe_read import sealed
from gridworld.storage.serialization import decode, encode
from gridworld.training.tensorboard import _checksum

SECRET = "the-secret-7f3a"
Spoil = Callable[[Path, Path], None]


@dataclass(frozen=True)
class Hostile:
    """An entry."""

    name: str
    spoil: Spoil  # (run, base)
    agent: str  # whose run it is made of
    words: str  # of evaluate's answer
    megabytes: int = 200  # that a command may take


CATALOGUE: list[Hostile] = []


def hostile(words: str, agent: str = "sarsa", megabytes: int = 200) -> Callable[[Spoil], Spoil]:
    """Put the function into the catalogue; evaluate's answer has `words`, or is as for a good run."""

    def add(spoil: Spoil) -> Spoil:
        CATALOGUE.append(Hostile(spoil.__name__, spoil, agent, words, megabytes))
        return spoil

    return add


FINE = "policy of run on"


class Bomb:
    """Runs a command when it is unpickled."""

    def __init__(self, base: Path) -> None:
        self.command = f"touch {base}/canary"

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


def manifest(run: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    """Change the manifest, and seal it."""
    content = json.loads((run / "manifest.json").read_text())
    edit(content)
    (run / "manifest.json").write_text(json.dumps(sealed(content)))


def agent_has(run: Path, **values: Any) -> None:
    """Change settings of the agent."""
    manifest(run, lambda content: content["config"]["agent"].update(values))


def seal(run: Path, name: str, content: bytes | None = None) -> None:
    """Write a file, and its checksum into the manifest."""
    if content is not None:
        (run / name).write_bytes(content)
    digest = hashlib.sha256((run / name).read_bytes()).hexdigest()
    manifest(run, lambda told: told["sha256"].update({name: digest}))


def link(path: Path, target: Path | str) -> None:
    """Put a symbolic link in the place of whatever is there."""
    if path.is_dir() and not path.is_symlink():
        path.rename(path.with_name(f"{path.name}-before"))
    path.unlink(missing_ok=True)
    path.symlink_to(target)


def zipped(members: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> bytes:
    """A zip file."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def model(run: Path, **changes: bytes) -> None:
    """Replace members of the model file; `policy__pth` is policy.pth."""
    with zipfile.ZipFile(run / "model.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members |= {name.replace("__", "."): content for name, content in changes.items()}
    seal(run, "model.zip", zipped(members))


def weights(run: Path, edit: Callable[[dict[str, torch.Tensor]], object]) -> None:
    """Change the policy's tensors."""
    with zipfile.ZipFile(run / "model.zip") as archive:
        content = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
    edit(content)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    model(run, policy__pth=buffer.getvalue())


def torch_file(pickled: bytes, kind: int = zipfile.ZIP_STORED) -> bytes:
    """What torch would write, had it written this pickle."""
    return zipped(
        {"archive/data.pkl": pickled, "archive/version": b"3\n", "archive/byteorder": b"little"}, kind
    )


def arrays(run: Path, name: str, content: bytes) -> None:
    """Replace an array of a table's model file."""
    with zipfile.ZipFile(run / "model.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    seal(run, "model.zip", zipped(members | {f"{name}.npy": content}))


def header(text: str) -> bytes:
    """The beginning of a file in NumPy's format."""
    line = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(line).to_bytes(2, "little") + line


def pickled_array(base: Path) -> bytes:
    """An array of objects, as NumPy pickles it."""
    buffer = io.BytesIO()
    np.save(buffer, np.array([Bomb(base)], dtype=object), allow_pickle=True)
    return buffer.getvalue()


def sparse(path: Path, size: int) -> None:
    """A file that claims to be large and takes no room."""
    path.unlink(missing_ok=True)
    with path.open("wb") as file:
        file.truncate(size)


def png(width: int, height: int) -> bytes:
    """A picture whose pixels are much larger than its file."""
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + 3 * width)) for _ in range(height)) + packer.flush()
    size = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 2, 0, 0, 0])

    def chunk(name: bytes, content: bytes) -> bytes:
        parts = len(content).to_bytes(4, "big"), name, content, zlib.crc32(name + content).to_bytes(4, "big")
        return b"".join(parts)

    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


# ---- the model of a network --------------------------------------------------------------------------------


@hostile(FINE, "dqn")
def pickle_where_sb3_would_read_one(run: Path, base: Path) -> None:
    payload = base64.b64encode(pickle.dumps(Bomb(base))).decode()
    text = json.dumps(
        {"policy_class": {":type:": "x", ":serialized:": payload}, "exploration_rate": 0.1}, indent=4
    )
    model(run, data=text.encode())


@hostile("not a model of dqn", "dqn")
def pickle_as_weights(run: Path, base: Path) -> None:
    model(run, policy__pth=pickle.dumps(Bomb(base)))


@hostile("its pickle asks for posix system", "dqn")
def pickle_in_torchs_own_file(run: Path, base: Path) -> None:
    model(run, policy__pth=torch_file(pickle.dumps(Bomb(base), protocol=2)))


@hostile("its pickle asks for", "dqn")
def pickle_of_a_newer_protocol(run: Path, base: Path) -> None:
    model(run, policy__pth=torch_file(pickle.dumps(Bomb(base), protocol=4)))


@hostile("not a model of dqn", "dqn")
def pickle_beside_the_weights(run: Path, base: Path) -> None:
    model(run, evil__pth=pickle.dumps(Bomb(base)))


@hostile(FINE, "dqn")
def pickle_as_sb3s_variables(run: Path, base: Path) -> None:
    model(run, pytorch_variables__pth=pickle.dumps(Bomb(base)))


@hostile("its pickle asks for builtins bytearray", "dqn")
def pickle_that_asks_for_memory(run: Path, base: Path) -> None:
    model(run, policy__pth=torch_file(b"\x80\x02cbuiltins\nbytearray\n\x8a\x05\x00\xe8vH\x17\x85R."))


@hostile("compressed members", "dqn")
def zip_bomb(run: Path, base: Path) -> None:
    seal(run, "model.zip", zipped({"policy.pth": bytes(2**28)}, zipfile.ZIP_DEFLATED))


@hostile("compressed members", "dqn")
def zip_bomb_inside(run: Path, base: Path) -> None:
    model(run, policy__pth=torch_file(bytes(2**28), zipfile.ZIP_DEFLATED))


@hostile("members are larger than itself", "dqn")
def zip_whose_members_share_their_bytes(run: Path, base: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.pth", bytes(2**20))
        first = archive.infolist()[0]
        for index in range(500):
            again = zipfile.ZipInfo(f"{index}.pth")
            again.header_offset, again.CRC = first.header_offset, first.CRC
            again.file_size = again.compress_size = first.file_size
            archive.filelist.append(again)
    seal(run, "model.zip", buffer.getvalue())


@hostile("its pickle asks for torch._utils _rebuild_sparse_tensor", "dqn")
def a_tensor_without_numbers(run: Path, base: Path) -> None:
    def edit(content: dict[str, torch.Tensor]) -> None:
        content["q_net.q_net.0.weight"] = content["q_net.q_net.0.weight"].to_sparse()

    weights(run, edit)


@hostile("it must be float32", "dqn")
def a_tensor_of_a_trillion_numbers(run: Path, base: Path) -> None:
    weights(run, lambda content: content.update({"q_net.q_net.0.weight": torch.zeros(1).expand(10**12)}))


@hostile("holds numbers that are not finite", "dqn")
def weights_that_are_no_numbers(run: Path, base: Path) -> None:
    weights(run, lambda content: content["q_net.q_net.0.weight"].fill_(float("nan")))


@hostile("it must be float32", "dqn")
def weights_of_another_type(run: Path, base: Path) -> None:
    key = "q_net.q_net.0.weight"
    weights(run, lambda content: content.update({key: content[key].double()}))


@hostile("is missing", "dqn")
def weights_left_out(run: Path, base: Path) -> None:
    weights(run, lambda content: content.pop("q_net.q_net.0.weight"))


@hostile("exploration_rate=7.0: must be from 0 to 1", "dqn")
def exploration_beyond_all_bounds(run: Path, base: Path) -> None:
    model(run, data=b'{\n    "exploration_rate": 7\n}')


@hostile("is not the file that the run wrote", "dqn")
def one_weight_changed_and_not_sealed(run: Path, base: Path) -> None:
    before = json.loads((run / "manifest.json").read_text())["sha256"]
    weights(run, lambda content: content["q_net.q_net.0.weight"][0, 0].add_(1))
    manifest(run, lambda told: told.update(sha256=before))


@hostile("has no checksum (sha256) of model.zip", "dqn")
def checksums_taken_out(run: Path, base: Path) -> None:
    manifest(run, lambda content: content.pop("sha256"))


@hostile("model.zip: is a symbolic link", "dqn")
def model_that_is_the_secret(run: Path, base: Path) -> None:
    link(run / "model.zip", base / "secret.txt")


@hostile("model.zip: is a symbolic link", "dqn")
def model_that_never_ends(run: Path, base: Path) -> None:
    link(run / "model.zip", "/dev/zero")


@hostile("model.zip: is no ordinary file", "dqn")
def model_that_waits_for_a_writer(run: Path, base: Path) -> None:
    (run / "model.zip").unlink()
    os.mkfifo(run / "model.zip")


@hostile("model.zip: is larger than", "dqn")
def model_of_twenty_gigabytes(run: Path, base: Path) -> None:
    sparse(run / "model.zip", 20 * 2**30)


# ---- tables ------------------------------------------------------------------------------------------------


@hostile("Object arrays cannot be loaded")
def pickle_in_a_table(run: Path, base: Path) -> None:
    arrays(run, "q", pickled_array(base))


@hostile("not a model of sarsa")
def table_of_a_trillion_numbers(run: Path, base: Path) -> None:
    arrays(run, "q", header(f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({10**12},), }}"))


@hostile("its members are larger than itself")
def table_that_is_a_bomb(run: Path, base: Path) -> None:
    seal(run, "model.zip", zipped({"q.npy": bytes(2**28)}, zipfile.ZIP_DEFLATED))


@hostile(FINE)
def pickle_as_visits(run: Path, base: Path) -> None:
    seal(run, "visits.npy", pickled_array(base))


@hostile(FINE)
def visits_that_are_the_secret(run: Path, base: Path) -> None:
    link(run / "visits.npy", base / "secret.txt")


@hostile(FINE)
def visits_of_a_trillion_cells(run: Path, base: Path) -> None:
    seal(run, "visits.npy", header(f"{{'descr': '<i8', 'fortran_order': False, 'shape': ({10**12}, 4), }}"))


# ---- settings ----------------------------------------------------------------------------------------------


@hostile("config.agent: has an unknown key _target_")
def target_among_the_settings(run: Path, base: Path) -> None:
    agent_has(run, _target_="os.system", command=f"touch {base}/canary")


@hostile("optimizer_kwargs.eps._target_=os.system is no plain word", "dqn")
def target_among_an_optimisers_arguments(run: Path, base: Path) -> None:
    target = {"_target_": "os.system", "command": f"touch {base}/canary", "_recursive_": True}
    manifest(run, lambda c: c["config"]["agent"]["policy_kwargs"].update(optimizer_kwargs={"eps": target}))


@hostile("policy of run on ${oc.env:HOME}")
def interpolation_in_names(run: Path, base: Path) -> None:
    def edit(content: dict[str, Any]) -> None:
        content["config"]["agent"]["name"] = "${oc.env:GRIDWORLD_SECRET}"
        content["config"]["env"]["layout"] = "${oc.env:HOME}"

    manifest(run, edit)


@hostile("unknown tile")
def interpolation_in_the_map(run: Path, base: Path) -> None:
    manifest(run, lambda content: content.update(layout=["${oc.env:GRIDWORLD_SECRET}"]))


@hostile("must be float")
def interpolation_in_a_number(run: Path, base: Path) -> None:
    manifest(run, lambda content: content["config"]["env"].update(slip="${oc.env:GRIDWORLD_SECRET}"))


@hostile("activation_fn=os.system is from none of", "dqn")
def function_in_a_classs_place(run: Path, base: Path) -> None:
    manifest(run, lambda c: c["config"]["agent"]["policy_kwargs"].update(activation_fn="os.system"))


@hostile("must be the import path of a", "dqn")
def function_of_a_known_library(run: Path, base: Path) -> None:
    path = "stable_baselines3.common.save_util.load_from_pkl"
    manifest(run, lambda c: c["config"]["agent"]["policy_kwargs"].update(features_extractor_class=path))


@hostile("agent.replay_buffer_kwargs.filename_or_file=", "dqn")
def class_that_opens_a_file(run: Path, base: Path) -> None:
    name = {"filename_or_file": str(base / "outside" / "log")}
    path = "stable_baselines3.common.logger.HumanOutputFormat"
    agent_has(run, replay_buffer_class=path, replay_buffer_kwargs=name)


def plant(base: Path) -> None:
    """A module of the stranger's, where Python would find it."""
    (base / "evil.py").write_text(f"open({str(base / 'canary')!r}, 'w')\nclass Agent: pass\n")


@hostile("algorithm=evil.Agent is from none of", "qrdqn")
def algorithm_of_ones_own(run: Path, base: Path) -> None:
    plant(base)
    agent_has(run, algorithm="evil.Agent")


@hostile("policy=evil.Agent is from none of", "qrdqn")
def policy_of_ones_own(run: Path, base: Path) -> None:
    plant(base)
    agent_has(run, policy="evil.Agent")


@hostile("optimizer_class=evil.Agent is from none of", "qrdqn")
def class_deep_among_the_arguments(run: Path, base: Path) -> None:
    plant(base)
    agent_has(run, arguments={"policy_kwargs": [[{"x": [{"optimizer_class": "evil.Agent"}]}]]})


@hostile("agent.arguments.tensorboard_log=", "qrdqn")
def log_folder_among_the_arguments(run: Path, base: Path) -> None:
    agent_has(run, arguments={"tensorboard_log": str(base / "outside")})


@hostile(FINE)
def map_file_that_is_the_secret(run: Path, base: Path) -> None:
    manifest(run, lambda content: content["config"]["env"].update(layout="secret.txt"))


@hostile(FINE)
def map_file_elsewhere_that_is_the_secret(run: Path, base: Path) -> None:
    world_is(run, layout=str(base / "secret.txt"))


def world_is(run: Path, **values: Any) -> None:
    """Change the settings of the world, so that resume goes on with them and draws the episode."""

    def edit(content: dict[str, Any]) -> None:
        content["config"]["env"].update(values)
        content["config"]["recording"].update(gif=True)

    manifest(run, edit)
    content = json.loads((run / "manifest.json").read_text())
    own = identity(read_config(content["config"], ""), "\n".join(content["layout"]))
    checkpoint(run, lambda state: state.update(identity=own))


@hostile(FINE, "lake")
def environment_of_a_module(run: Path, base: Path) -> None:
    plant(base)
    world_is(run, id="evil:FrozenLake-v1")


@hostile(FINE, "lake")
def environment_that_opens_a_file(run: Path, base: Path) -> None:
    world_is(run, id="gridworld:GridWorld-v0", kwargs={"layout": str(base / "secret.txt")})


@hostile(FINE, "lake", megabytes=1000)
def environment_of_four_million_cells(run: Path, base: Path) -> None:
    world_is(run, kwargs={"desc": ["S" + "F" * 1998 + "G"] * 2000})


@hostile(FINE, "lake")
def environment_of_another_kind(run: Path, base: Path) -> None:
    world_is(run, id="Pendulum-v1", kwargs={})


@hostile(FINE, "lake")
def environment_that_a_command_builds(run: Path, base: Path) -> None:
    built = {"source": "built", "builder": "os.system", "kwargs": {"command": f"touch {base}/canary"}}
    manifest(run, lambda content: content["config"].update(env=built | {"max_episode_steps": None}))


@hostile("world.npz: is a symbolic link", "lake")
def world_that_is_the_secret(run: Path, base: Path) -> None:
    link(run / "world.npz", base / "secret.txt")


@hostile("world.npz: is a symbolic link", "lake")
def world_that_never_ends(run: Path, base: Path) -> None:
    link(run / "world.npz", "/dev/zero")


@hostile("world.npz: is no ordinary file", "lake")
def world_that_waits_for_a_writer(run: Path, base: Path) -> None:
    (run / "world.npz").unlink()
    os.mkfifo(run / "world.npz")


def in_world(run: Path, **arrays: Any) -> None:
    """Change arrays of the world's file, whose checksum is right again."""
    with np.load(run / "world.npz") as there:
        seal(
            run, "world.npz", npz_bytes(dict(there) | {key: np.asarray(each) for key, each in arrays.items()})
        )


@hostile("world.npz: would take about 1.35 GB", "lake")
def world_of_450_megabytes(run: Path, base: Path) -> None:
    sparse(run / "world.npz", 450_000_000)


@hostile("world.npz: not a world that can be read (its members are larger than itself)", "lake")
def world_that_grows(run: Path, base: Path) -> None:
    with zipfile.ZipFile(run / "world.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    zeros = header("{'descr': '|u1', 'fortran_order': False, 'shape': (200000000,), }") + bytes(200_000_000)
    content = zipped(members | {"own_observation.npy": zeros}, zipfile.ZIP_DEFLATED)
    seal(run, "world.npz", content)


@hostile("world.npz: not a world that can be read (('EOF in multi-line", "lake")
def world_whose_header_is_cut_off(run: Path, base: Path) -> None:
    with zipfile.ZipFile(run / "world.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    seal(run, "world.npz", zipped(members | {"reward.npy": header("((((")}))


@hostile(FINE)
def visits_whose_header_is_cut_off(run: Path, base: Path) -> None:
    seal(run, "visits.npy", header("(((("))


@hostile("world.npz: not a world", "lake")
def world_that_is_pickled(run: Path, base: Path) -> None:
    with zipfile.ZipFile(run / "world.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    seal(run, "world.npz", zipped(members | {"name.npy": pickled_array(base)}))


@hostile("world.npz: is not the world that manifest.json names", "lake")
def world_with_another_digit(run: Path, base: Path) -> None:
    with np.load(run / "world.npz") as there:
        in_world(run, reward=np.where(there["reward"] == 1, 0.5, there["reward"]))


@hostile("world.npz: is not the file that the run wrote", "lake")
def world_that_shows_another_digit(run: Path, base: Path) -> None:
    sums = json.loads((run / "manifest.json").read_text())["sha256"]["world.npz"]
    in_world(run, action_names=["a", "b", "c", "e"])
    manifest(run, lambda told: told["sha256"].update({"world.npz": sums}))


@hostile(FINE)
def films_that_are_the_secret(run: Path, base: Path) -> None:
    link(run / "episode.gif", base / "secret.png")
    link(run / "episode.mp4", "/dev/zero")


@hostile("at most 262144 cells")
def map_of_a_million_cells(run: Path, base: Path) -> None:
    manifest(run, lambda content: content.update(layout=["S" + "." * 998 + "G"] * 1000))


@hostile("n_envs=1000000000000: must be from 1 to")
def a_trillion_environments(run: Path, base: Path) -> None:
    manifest(run, lambda content: content["config"].update(n_envs=10**12))


@hostile(FINE, "dqn")
def a_replay_of_a_trillion_steps(run: Path, base: Path) -> None:
    agent_has(run, buffer_size=10**13)


@hostile("must be layer widths", "dqn")
def a_network_of_a_trillion_weights(run: Path, base: Path) -> None:
    manifest(run, lambda c: c["config"]["agent"]["policy_kwargs"].update(net_arch=[10**6, 10**6]))


@hostile("env.max_episode_steps=1000000000000: must be from 1 to")
def an_episode_of_a_trillion_steps(run: Path, base: Path) -> None:
    manifest(run, lambda content: content["config"]["env"].update(max_episode_steps=10**12))


def seen_as_image(run: Path, cell_size: int) -> None:
    """Have the agent see frames."""
    agent_has(run, policy="CnnPolicy")
    manifest(run, lambda c: c["config"]["observation"].update(kind="image", cell_size=cell_size))


@hostile("its network: would take about", "qrdqn", 1000)
def ten_million_quantiles(run: Path, base: Path) -> None:
    agent_has(run, arguments={"policy_kwargs": {"n_quantiles": 10_000_000}})


@hostile("image, cells of 400 pixels: would take about", "dqn", 1000)
def images_of_cells_of_400_pixels(run: Path, base: Path) -> None:
    seen_as_image(run, 400)


@hostile("its network: would take about", "dqn", 1000)
def images_that_fill_the_memory(run: Path, base: Path) -> None:
    seen_as_image(run, 4)
    manifest(run, lambda c: c.update(layout=["S" + "." * 64 + "G"] * 66))


@hostile("its network: would take about", "dqn", 1000)
def sixteen_layers_of_4096(run: Path, base: Path) -> None:
    manifest(run, lambda c: c["config"]["agent"]["policy_kwargs"].update(net_arch=[4096] * 16))


@hostile("its network: would take about", "qrdqn", 1000)
def many_quantiles_of_every_state(run: Path, base: Path) -> None:
    agent_has(run, arguments={"policy_kwargs": {"n_quantiles": 20_000}})
    manifest(run, lambda c: c.update(layout=["S" + "." * 62 + "G"] * 64))


@hostile(FINE, "dqn", 1000)
def a_replay_of_gigabytes(run: Path, base: Path) -> None:
    agent_has(run, buffer_size=500_000_000)


# ---- the manifest as a file --------------------------------------------------------------------------------


@hostile("manifest.json: is larger than 4 MiB")
def manifest_of_ten_gigabytes(run: Path, base: Path) -> None:
    sparse(run / "manifest.json", 10 * 2**30)


@hostile("manifest.json: is no JSON")
def manifest_nested_a_hundred_thousand_deep(run: Path, base: Path) -> None:
    (run / "manifest.json").write_text("[" * 100_000 + "]" * 100_000)


@hostile("nested too deeply", "qrdqn")
def settings_nested_as_deep_as_json_goes(run: Path, base: Path) -> None:
    text = (run / "manifest.json").read_text()
    deep = '{"a":' * 900 + "1" + "}" * 900
    at = text.index('"arguments": {') + len('"arguments": {')
    text = f'{text[:at]}"deep": {deep},{text[at:]}'
    (run / "manifest.json").write_text(text)


@hostile("manifest.json: is a symbolic link")
def manifest_that_is_the_secret(run: Path, base: Path) -> None:
    link(run / "manifest.json", base / "secret.json")


@hostile("manifest.json: is no ordinary file")
def manifest_that_waits_for_a_writer(run: Path, base: Path) -> None:
    (run / "manifest.json").unlink()
    os.mkfifo(run / "manifest.json")


@hostile("config.agent.name='\\x1b]0;owned")
def names_that_act_on_the_terminal(run: Path, base: Path) -> None:
    agent_has(run, name="\x1b]0;owned\x07\x1b[2J\r\n\u202e")


@hostile("this run is '\\x1b[2J")
def status_that_acts_on_the_terminal(run: Path, base: Path) -> None:
    manifest(run, lambda content: content.update(status="\x1b[2J", error="\x1b[31m" * 1000))


@hostile("must be a plain name")
def names_that_are_no_text(run: Path, base: Path) -> None:
    manifest(run, lambda content: content["config"]["env"].update(layout="\ud800\x00"))


@hostile("config.seed=a list: must be int")
def a_megabyte_in_a_numbers_place(run: Path, base: Path) -> None:
    manifest(run, lambda content: content["config"].update(seed=["\x1b"] * 100_000))


# ---- what the report shows ---------------------------------------------------------------------------------


@hostile(FINE)
def names_that_are_scripts(run: Path, base: Path) -> None:
    agent_has(run, name="<script>fetch('//x')</script><img src=x onerror=alert(1)>{{7*7}}](javascript:x)")


@hostile(FINE)
def curve_of_a_million_columns(run: Path, base: Path) -> None:
    seal(run, "curve.csv", (",".join(f"c{i}" for i in range(10**6)) + "\n" + "1," * 10**6 + "\n").encode())


@hostile(FINE)
def curve_that_is_the_secret(run: Path, base: Path) -> None:
    link(run / "curve.csv", base / "secret.txt")


@hostile(FINE)
def summary_that_is_the_secret(run: Path, base: Path) -> None:
    link(run / "summary.json", base / "secret.json")


@hostile(FINE)
def picture_that_is_the_secret(run: Path, base: Path) -> None:
    link(run / "policy.png", base / "secret.png")


@hostile(FINE)
def picture_of_eighty_million_pixels(run: Path, base: Path) -> None:
    (run / "policy.png").write_bytes(png(9_000, 9_000))


@hostile(FINE)
def picture_that_waits_for_a_writer(run: Path, base: Path) -> None:
    (run / "learning.gif").unlink()
    os.mkfifo(run / "learning.gif")


# ---- where things are written ------------------------------------------------------------------------------


@hostile(FINE)
def recordings_that_lead_outside(run: Path, base: Path) -> None:
    link(run / "recording", base / "outside")


@hostile(FINE)
def frames_that_lead_outside(run: Path, base: Path) -> None:
    (run / "recording").mkdir()
    link(run / "recording" / "frames", base / "outside")
    for process in range(os.getpid(), os.getpid() + 2000):  # the reader's may be guessed
        for kind in ("part", "old.part"):
            link(run / "recording" / f".frames.{process}.{kind}", base / "outside")
    link(run / "frames", base / "outside")


@hostile(FINE)
def files_that_lead_outside(run: Path, base: Path) -> None:
    (run / "recording").mkdir()
    for name in ("episode.gif", "policy.png", "visits.png"):
        link(run / "recording" / name, base / "outside" / name)
        for process in range(os.getpid(), os.getpid() + 2000):  # the reader's may be guessed
            link(run / "recording" / f".{name}.{process}.part", base / "outside" / name)


@hostile(FINE)
def report_that_leads_outside(run: Path, base: Path) -> None:
    link(run / "report", base / "outside")


# ---- files that nobody should need -------------------------------------------------------------------------


@hostile(FINE)
def yaml_that_runs_and_grows(run: Path, base: Path) -> None:
    (run / ".hydra").mkdir(exist_ok=True)
    lines = ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 40))]
    for name in ("config.yaml", "hydra.yaml", "overrides.yaml"):
        evil = f'evil: !!python/object/apply:os.system ["touch {base}/canary"]'
        (run / ".hydra" / name).write_text("\n".join([*lines, evil, "b: ${oc.env:GRIDWORLD_SECRET}"]))


@hostile(FINE)
def modules_that_shadow_pythons(run: Path, base: Path) -> None:
    for name in ("json", "numpy", "torch", "gridworld", "sitecustomize", "usercustomize", "conftest"):
        (run / f"{name}.py").write_text(f"open({str(base / 'canary')!r}, 'w')\n")


@hostile(FINE)
def diff_that_is_the_secret(run: Path, base: Path) -> None:
    link(run / "source.diff", base / "secret.txt")


@hostile(FINE)
def event_of_an_exabyte(run: Path, base: Path) -> None:
    length = struct.pack("<Q", 2**60)
    next(run.glob("events*")).write_bytes(length + _checksum(length) + b"x")


def record(content: bytes) -> bytes:
    """A record of an event file."""
    length = struct.pack("<Q", len(content))
    return b"".join([length, _checksum(length), content, _checksum(content)])


@hostile(FINE, megabytes=1000)
def event_of_many_empty_values(run: Path, base: Path) -> None:
    values = b"\n\0" * 20_000_000  # a protocol buffer's field 1, empty
    length = b"\x80\xb4\x89\x13"  # 40,000,000 in sevens of bits
    next(run.glob("events*")).write_bytes(record(b"\x2a" + length + values))


@hostile(FINE, megabytes=1000)
def a_million_events(run: Path, base: Path) -> None:
    event = record(b"\x10\x01\x2a\x0a\n\x08\n\x01a\x15\0\0\x80\x3f")  # step 1, a = 1
    next(run.glob("events*")).write_bytes(event * 1_000_000)


@hostile(FINE, megabytes=1000)
def curve_of_millions_of_short_rows(run: Path, base: Path) -> None:
    seal(run, "curve.csv", b"ab,12\n" * 10_000_000)


@hostile(FINE)
def events_that_wait_for_a_writer(run: Path, base: Path) -> None:
    os.mkfifo(run / "events.out.tfevents.0.a.1")


@hostile(FINE)
def events_that_are_the_secret(run: Path, base: Path) -> None:
    link(run / "events.out.tfevents.0.a.1", base / "secret.txt")


# ---- what resume goes on with ------------------------------------------------------------------------------


def checkpoint(run: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    """Change the newest checkpoint, whose checksum is right again."""
    path = max((run / "checkpoints").glob("*.state"))
    state = decode(path.read_bytes())
    edit(state)
    path.write_bytes(encode(state))


def mark_of_nothing(run: Path, part: str, name: str) -> None:
    """A mark that every file holds, and that a run would cut it back to."""
    mark = {"name": name, "length": 0, "sha256": hashlib.sha256(b"").hexdigest()}
    checkpoint(run, lambda state: state["marks"].update({part: mark}))


@hostile(FINE)
def mark_of_a_curve_outside(run: Path, base: Path) -> None:
    mark_of_nothing(run, "curve", "curve.csv")
    (base / "outside" / "kept").write_text("kept")
    link(run / "curve.csv", base / "outside" / "kept")


@hostile(FINE)
def mark_of_events_outside(run: Path, base: Path) -> None:
    mark_of_nothing(run, "events", "x")
    (base / "outside" / "kept").write_text("kept")
    link(run / "x", base / "outside" / "kept")


@hostile(FINE)
def mark_of_another_file_of_the_run(run: Path, base: Path) -> None:
    mark_of_nothing(run, "curve", "manifest.json")


@hostile(FINE)
def checkpoints_that_lead_outside(run: Path, base: Path) -> None:
    shutil.copytree(run / "checkpoints", base / "outside" / "checkpoints")
    for name in ("000000000001.state", "999999999999.state", ".x.part"):
        (base / "outside" / "checkpoints" / name).write_text("kept")
    link(run / "checkpoints", base / "outside" / "checkpoints")


@hostile(FINE)
def curve_that_waits_for_a_writer(run: Path, base: Path) -> None:
    (run / "curve.csv").unlink()
    os.mkfifo(run / "curve.csv")


@hostile(FINE)
def checkpoint_that_waits_for_a_writer(run: Path, base: Path) -> None:
    os.mkfifo(run / "checkpoints" / "999999999999.state")


@hostile(FINE)
def checkpoint_that_is_a_folder(run: Path, base: Path) -> None:
    (run / "checkpoints" / "999999999999.state").mkdir()


@hostile(FINE)
def checkpoint_that_acts_on_the_terminal(run: Path, base: Path) -> None:
    forged_checkpoint(run, b'{"a":{"@":"x"}}', {"\x1b[31m\x1b]0;x\x07.npy": b"x"})


def forged_checkpoint(run: Path, text: bytes, arrays: dict[str, bytes] | None = None) -> None:
    """A newest one of this JSON and these files of arrays, whose checksums are right."""
    content = zipped({"state.json": text, **(arrays or {})})
    (run / "checkpoints" / "999999999999.state").write_bytes(content)


@hostile(FINE, megabytes=1000)
def checkpoint_of_seven_gigabytes(run: Path, base: Path) -> None:
    sparse(run / "checkpoints" / "999999999999.state", 7 * 2**30)


@hostile(FINE, megabytes=1000)
def checkpoint_of_sixty_megabytes_of_json(run: Path, base: Path) -> None:
    forged_checkpoint(run, b'{"arrays":[],"state":{"a":[' + b"[],[]," * 10_000_000 + b"[]]}}")


@hostile(FINE, megabytes=1000)
def checkpoint_of_an_array_that_is_left_out(run: Path, base: Path) -> None:
    head = io.BytesIO()
    about = {"descr": "<f8", "fortran_order": False, "shape": (30_000_000_000,)}
    np.lib.format.write_array_header_1_0(head, about)
    forged_checkpoint(run, b'{"a":{"@":"a"}}', {"a.npy": head.getvalue()})


@hostile(FINE, megabytes=1000)
def checkpoint_of_zeros_that_are_packed(run: Path, base: Path) -> None:
    content = zipped({"state.json": b"{}", "a.npy": bytes(2 * 10**9)}, zipfile.ZIP_DEFLATED)
    (run / "checkpoints" / "999999999999.state").write_bytes(content)


@hostile("resumed must be a list of when the run went on")
def continuations_that_are_no_list(run: Path, base: Path) -> None:
    manifest(run, lambda content: content.update(resumed={"a": 1}))


@hostile("resumed must be a list of when the run went on")
def continuations_without_a_step(run: Path, base: Path) -> None:
    manifest(run, lambda content: content.update(resumed=[{"total_timesteps": 1}]))


@hostile("resumed must be a list of when the run went on")
def continuations_after_no_number_of_steps(run: Path, base: Path) -> None:
    manifest(run, lambda content: content.update(resumed=[{"total_timesteps": 1, "step": "x"}]))


@hostile("manifest.json: is no JSON")
def numbers_that_json_has_not(run: Path, base: Path) -> None:
    manifest(run, lambda content: content.update(reached=float("nan"), seed=float("inf")))
