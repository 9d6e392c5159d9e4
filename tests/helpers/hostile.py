"""Run folders as somebody would make them who means harm, or does not care: a catalogue.

Each entry takes a good run's folder and spoils it. Whatever can be sealed again, is: checksums in a
stranger's manifest are the stranger's. `base`, in texts `{base}`, holds the folder with the run, and

    secret.txt, secret.json, secret.png   that no command may read, or tell of
    outside/     that no command may write to; it has a file, kept
    evil.py      a module that no command may import, with a class Agent
    canary       a path that code out of a run would create
"""

import base64
import functools
import hashlib
import io
import json
import os
import pickle
import random
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

from gridworld.base.safe_read import sealed
from gridworld.base.serialization import decode, encode
from gridworld.base.user_input import npz_bytes
from gridworld.config.settings import read_config
from gridworld.run.provenance import identity
from gridworld.training.tensorboard import _checksum

SECRET = "the-secret-7f3a"
_FIRST_WEIGHTS = "q_net.q_net.0.weight"
FINE = "policy of run on"  # evaluate answers as for a good run
Spoil = Callable[[Path, Path], object]  # (run, base)
Content = bytes | Callable[[Path], bytes]  # of a file; the function takes base


@dataclass(frozen=True)
class Hostile:
    """An entry."""

    agent: str  # whose run it is made of
    name: str
    words: str  # of evaluate's answer
    spoil: Spoil
    megabytes: int = 200  # that a command may take


class Bomb:
    """Runs a command when it is unpickled."""

    def __init__(self, base: Path) -> None:
        self.command = f"touch {base}/canary"

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


# ---- changes of a run, which other tests make too ----------------------------------------------------------


def manifest(run: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    """Change the manifest, and seal it."""
    content = json.loads((run / "manifest.json").read_text())
    edit(content)
    (run / "manifest.json").write_text(json.dumps(sealed(content)))


def seal(run: Path, name: str, content: bytes | None = None) -> None:
    """Write a file, and its checksum into the manifest."""
    if content is not None:
        (run / name).write_bytes(content)
    digest = hashlib.sha256((run / name).read_bytes()).hexdigest()
    manifest(run, lambda told: told["sha256"].update({name: digest}))


def weights(run: Path, edit: Callable[[dict[str, torch.Tensor]], object]) -> None:
    """Change the policy's tensors."""
    content = torch.load(io.BytesIO(_members(run / "model.zip")["policy.pth"]), weights_only=True)
    edit(content)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    members("model.zip", {"policy.pth": buffer.getvalue()})(run, run)


def damaged(chance: random.Random, raw: bytes) -> bytes:
    """Some bytes changed, cut off, put in or doubled."""
    content = bytearray(raw)
    for _ in range(chance.choice([1, 1, 1, 2, 8])):
        place = chance.randrange(len(content))
        match chance.choice(["flip", "flip", "flip", "set", "cut", "put", "double"]):
            case "flip":
                content[place] ^= 1 << chance.randrange(8)
            case "set":
                extremes = [b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff"]
                content[place : place + 4] = chance.choice(extremes)
            case "cut":
                del content[place : place + chance.choice([1, 100, len(content)])]
                content += b"" if content else b"x"
            case "put":
                content[place:place] = chance.randbytes(chance.choice([1, 50]))
            case "double":
                content[place:place] = content[place : place + 200]
    return bytes(content)


# ---- kinds of damage ---------------------------------------------------------------------------------------


def spoiling(act: Callable[..., object]) -> Callable[..., Spoil]:
    """The function, given all but the run and the base, is what does it to a run."""
    return lambda *given, **named: lambda run, base: act(run, base, *given, **named)


@spoiling
def members(
    run: Path, base: Path, file: str, changes: dict[str, Content], kind: int = zipfile.ZIP_STORED
) -> None:
    """Replace members of a zip file, or put them in."""
    seal(
        run,
        file,
        zipped(_members(run / file) | {name: _bytes(changes[name], base) for name in changes}, kind),
    )


def _members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _bytes(content: Content, base: Path) -> bytes:
    return content if isinstance(content, bytes) else content(base)


def zipped(members: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> bytes:
    """A zip file."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


@spoiling
def file(run: Path, base: Path, name: str, content: Content) -> None:
    """Write a file, and its checksum."""
    seal(run, name, _bytes(content, base))


@spoiling
def packed(run: Path, base: Path, name: str, member: str, size: int) -> None:
    """A zip file of zeros, which takes no room."""
    seal(run, name, zipped({member: bytes(size)}, zipfile.ZIP_DEFLATED))


@spoiling
def linked(run: Path, base: Path, name: str, target: str) -> None:
    """A symbolic link in the place of whatever is there."""
    path = run / name
    path.parent.mkdir(exist_ok=True)
    if path.is_dir() and not path.is_symlink():
        path.rename(path.with_name(f"{path.name}-before"))
    path.unlink(missing_ok=True)
    path.symlink_to(target.format(base=base))


@spoiling
def waiting(run: Path, base: Path, name: str) -> None:
    """A pipe: whoever opens it waits for a writer."""
    (run / name).unlink(missing_ok=True)
    os.mkfifo(run / name)


@spoiling
def grown(run: Path, base: Path, name: str, size: int) -> None:
    """A file that claims to be large and takes no room."""
    (run / name).write_bytes(b"")
    os.truncate(run / name, size)


@spoiling
def said(run: Path, base: Path, **values: Any) -> None:
    """Entries of the manifest."""
    manifest(run, lambda content: content.update(_placed(values, base)))


@spoiling
def settings(run: Path, base: Path, changes: dict[str, Any]) -> None:
    """Settings in the manifest, by dotted names."""

    def edit(content: dict[str, Any]) -> None:
        for name, value in _placed(changes, base).items():
            *path, last = name.split(".")
            functools.reduce(dict.__getitem__, path, content["config"])[last] = value

    manifest(run, edit)


def _placed(value: Any, base: Path) -> Any:
    """With the base in the place of `{base}`."""
    if isinstance(value, dict):
        return {key: _placed(each, base) for key, each in value.items()}
    return value.replace("{base}", str(base)) if isinstance(value, str) else value


@spoiling
def world(run: Path, base: Path, **values: Any) -> None:
    """Settings of the world, so that resume goes on with them and draws the episode."""
    changes = {f"env.{name}": value for name, value in values.items()}
    settings({**changes, "recording.gif": True})(run, base)
    content = json.loads((run / "manifest.json").read_text())
    own = identity(read_config(content["config"], ""), "\n".join(content["layout"]))
    checkpoint(lambda state: state.update(identity=own))(run, base)


@spoiling
def checkpoint(run: Path, base: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    """Change the newest checkpoint, whose checksum is right again."""
    path = max((run / "checkpoints").glob("*.state"))
    state = decode(path.read_bytes())
    edit(state)
    path.write_bytes(encode(state))


def mark_of_nothing(part: str, name: str) -> Spoil:
    """A mark in the checkpoint that every file holds, and that a run would cut it back to."""
    mark = {"name": name, "length": 0, "sha256": hashlib.sha256(b"").hexdigest()}
    return checkpoint(lambda state: state["marks"].update({part: mark}))


@spoiling
def newest_checkpoint(run: Path, base: Path, text: Content, arrays: dict[str, bytes] | None = None) -> None:
    """One of this JSON and these files of arrays, whose checksums are right."""
    (run / LAST).write_bytes(zipped({"state.json": _bytes(text, base), **(arrays or {})}))


@spoiling
def tensor(run: Path, base: Path, edit: Callable[[torch.Tensor], torch.Tensor]) -> None:
    """Another tensor in the place of the first weights."""
    weights(run, lambda content: content.update({_FIRST_WEIGHTS: edit(content[_FIRST_WEIGHTS])}))


@spoiling
def array(run: Path, base: Path, name: str, edit: Callable[[Any], Any]) -> None:
    """Change an array of the world's file, whose checksum is right again."""
    with np.load(run / "world.npz") as there:
        content = dict(there)
    seal(run, "world.npz", npz_bytes(content | {name: edit(content[name])}))


@spoiling
def unsealed(run: Path, base: Path, name: str, spoil: Spoil) -> None:
    """Damage to a file whose checksum stays as it was."""
    before = json.loads((run / "manifest.json").read_text())["sha256"][name]
    spoil(run, base)
    manifest(run, lambda told: told["sha256"].update({name: before}))


@spoiling
def all_of(run: Path, base: Path, *spoils: Spoil) -> None:
    """One after the other."""
    for each in spoils:
        each(run, base)


# ---- contents of files -------------------------------------------------------------------------------------


def pickled(protocol: int | None = None) -> Content:
    """A pickle that runs a command."""
    return lambda base: pickle.dumps(Bomb(base), protocol)


def sb3_data(base: Path) -> bytes:
    """What SB3 would unpickle beside the weights."""
    payload = base64.b64encode(pickle.dumps(Bomb(base))).decode()
    policy = {":type:": "x", ":serialized:": payload}
    return json.dumps({"policy_class": policy, "exploration_rate": 0.1}, indent=4).encode()


def torch_file(content: Content, kind: int = zipfile.ZIP_STORED) -> Content:
    """What torch would write, had it written this pickle."""
    others = {"archive/version": b"3\n", "archive/byteorder": b"little"}
    return lambda base: zipped({"archive/data.pkl": _bytes(content, base), **others}, kind)


def npy_header(text: str) -> bytes:
    """The beginning of a file in NumPy's format."""
    line = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(line).to_bytes(2, "little") + line


def npy(descr: str, *shape: int) -> bytes:
    """The same of an array, of which nothing follows."""
    return npy_header(f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}")


def pickled_array(base: Path) -> bytes:
    """An array of objects, as NumPy pickles it."""
    buffer = io.BytesIO()
    np.save(buffer, np.array([Bomb(base)], dtype=object), allow_pickle=True)
    return buffer.getvalue()


def shared_members(base: Path) -> bytes:
    """A zip file of 500 members that are the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.pth", bytes(2**20))
        first = archive.infolist()[0]
        for index in range(500):
            again = zipfile.ZipInfo(f"{index}.pth")
            again.header_offset, again.CRC = first.header_offset, first.CRC
            again.file_size = again.compress_size = first.file_size
            archive.filelist.append(again)
    return buffer.getvalue()


def png(side: int) -> bytes:
    """A white square whose pixels are much larger than its file."""
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + 3 * side)) for _ in range(side)) + packer.flush()
    size = side.to_bytes(4, "big") * 2 + bytes([8, 2, 0, 0, 0])

    def chunk(name: bytes, content: bytes) -> bytes:
        checksum = zlib.crc32(name + content).to_bytes(4, "big")
        return len(content).to_bytes(4, "big") + name + content + checksum

    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def event(content: bytes, length: int | None = None) -> bytes:
    """A record of an event file, which may claim to be longer."""
    head = struct.pack("<Q", len(content) if length is None else length)
    return b"".join([head, _checksum(head), content, _checksum(content)])


@spoiling
def events(run: Path, base: Path, content: Callable[[], bytes]) -> None:
    """Another content of the file for TensorBoard."""
    next(run.glob("events*")).write_bytes(content())


# ---- damage of one kind ------------------------------------------------------------------------------------


def nested_settings(run: Path, base: Path) -> None:
    """As deep as JSON goes."""
    deep = '"arguments": {"deep": ' + '{"a":' * 900 + "1" + "}" * 900 + ","
    text = (run / "manifest.json").read_text()
    (run / "manifest.json").write_text(text.replace('"arguments": {', deep, 1))


@spoiling
def guessed_names(run: Path, base: Path, *names: str) -> None:
    """Links to the outside for files, and for those that a reader would write first, in `recording`."""
    for name in names:
        target = base / "outside" / ("" if name == "frames" else name)
        linked(f"recording/{name}", str(target))(run, base)
        for process in range(os.getpid(), os.getpid() + 2000):  # the reader's may be guessed
            for kind in ("part", "old.part"):
                (run / "recording" / f".{name}.{process}.{kind}").symlink_to(target)


def hydra_files(run: Path, base: Path) -> None:
    """Yaml that runs a command, and grows to a terabyte."""
    (run / ".hydra").mkdir(exist_ok=True)
    lines = ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 40))]
    for name in ("config.yaml", "hydra.yaml", "overrides.yaml"):
        evil = f'evil: !!python/object/apply:os.system ["touch {base}/canary"]'
        (run / ".hydra" / name).write_text("\n".join([*lines, evil, "b: ${oc.env:GRIDWORLD_SECRET}"]))


def shadowing_modules(run: Path, base: Path) -> None:
    """Modules in the run's folder with the names of others."""
    for name in ("json", "numpy", "torch", "gridworld", "sitecustomize", "usercustomize", "conftest"):
        (run / f"{name}.py").write_text(f"open({str(base / 'canary')!r}, 'w')\n")


def checkpoints_outside(run: Path, base: Path) -> None:
    """The folder of checkpoints is a link."""
    shutil.copytree(run / "checkpoints", base / "outside" / "checkpoints")
    for name in ("000000000001.state", "999999999999.state", ".x.part"):
        (base / "outside" / "checkpoints" / name).write_text("kept")
    linked("checkpoints", "{base}/outside/checkpoints")(run, base)


# ---- the catalogue -----------------------------------------------------------------------------------------

LAST = "checkpoints/999999999999.state"
_PACKED, _TRILLION = zipfile.ZIP_DEFLATED, 10**12
_CANARY = "touch {base}/canary"
_SECRET_WORD = "${oc.env:GRIDWORLD_SECRET}"
_KWARGS = "agent.policy_kwargs"
_ESCAPES = "\x1b]0;owned\x07\x1b[2J\r\n\u202e"
_SCRIPT = "<script>fetch('//x')</script><img src=x onerror=alert(1)>{{7*7}}](javascript:x)"
_HUNGRY = "its network: would take about"
_NO_WORLD = "world.npz: not a world that can be read"
_RESUMED = "resumed must be a list of resumptions"


def model(**changes: Content) -> Spoil:
    """Members of the model file; `policy__pth` is policy.pth."""
    return members("model.zip", {name.replace("__", "."): content for name, content in changes.items()})


def _seen_as_image(cell_size: int) -> Spoil:
    seen = {"observation.kind": "image", "observation.cell_size": cell_size}
    return settings({"agent.policy": "CnnPolicy", **seen})


def _corridors(rows: int, floor: int) -> Spoil:
    return said(layout=["S" + "." * floor + "G"] * rows)


def _argument(**arguments: Any) -> Spoil:
    return settings({"agent.arguments": arguments})


# Of an agent's run: the entry's name, words of evaluate's answer, what is done; and a wider limit of memory.
# fmt: off
_ROWS: dict[str, list[tuple[Any, ...]]] = {
"dqn": [
    # the model file
    ("pickle_where_sb3_would_read_one", FINE, model(data=sb3_data)),
    ("pickle_as_weights", "not a model of dqn", model(policy__pth=pickled())),
    ("pickle_in_torchs_own_file", "its pickle asks for posix system",
     model(policy__pth=torch_file(pickled(2)))),
    ("pickle_as_sb3s_variables", FINE, model(pytorch_variables__pth=pickled())),
    ("pickle_that_asks_for_memory", "its pickle asks for builtins bytearray",
     model(policy__pth=torch_file(b"\x80\x02cbuiltins\nbytearray\n\x8a\x05\x00\xe8vH\x17\x85R."))),
    ("zip_bomb", "compressed members", packed("model.zip", "policy.pth", 2**28)),
    ("zip_bomb_inside", "compressed members", model(policy__pth=torch_file(lambda _: bytes(2**28), _PACKED))),
    ("a_tensor_without_numbers", "its pickle asks for torch._utils _rebuild_sparse_tensor",
     tensor(lambda there: there.to_sparse())),
    ("a_tensor_of_a_trillion_numbers", "it must be float32",
     tensor(lambda _: torch.zeros(1).expand(_TRILLION))),
    ("zip_whose_members_share_their_bytes", "members are larger than the file",
     file("model.zip", shared_members)),
    ("weights_left_out", "is missing",
     lambda run, base: weights(run, lambda content: content.pop(_FIRST_WEIGHTS))),
    ("weights_that_are_no_numbers", "contains numbers that are not finite",
     tensor(lambda there: there.fill_(float("nan")))),
    ("exploration_beyond_all_bounds", "exploration_rate=7.0: must be from 0 to 1",
     model(data=b'{\n    "exploration_rate": 7\n}')),
    ("one_weight_changed_and_not_sealed", "is not the file that the run wrote",
     unsealed("model.zip", tensor(lambda there: there + torch.eye(*there.shape)))),
    ("checksums_taken_out", "has no checksum (sha256) of model.zip", said(sha256={})),
    ("model_that_never_ends", "model.zip: is a symbolic link", linked("model.zip", "/dev/zero")),
    ("model_that_waits_for_a_writer", "model.zip: is not an ordinary file", waiting("model.zip")),
    # settings
    ("target_among_an_optimisers_arguments", "optimizer_kwargs.eps._target_=os.system is neither a plain",
     settings({f"{_KWARGS}.optimizer_kwargs": {"eps": {"_target_": "os.system", "command": _CANARY}}})),
    ("function_in_a_classs_place", "activation_fn=os.system is not from one of",
     settings({f"{_KWARGS}.activation_fn": "os.system"})),
    ("class_that_opens_a_file", "agent.replay_buffer_kwargs.filename_or_file=",
     settings({"agent.replay_buffer_class": "stable_baselines3.common.logger.HumanOutputFormat",
               "agent.replay_buffer_kwargs": {"filename_or_file": "{base}/outside/log"}})),
    ("a_replay_of_gigabytes", FINE, settings({"agent.buffer_size": 500_000_000}), 1000),
    ("sixteen_layers_of_4096", _HUNGRY, settings({f"{_KWARGS}.net_arch": [4096] * 16}), 1000),
    ("images_of_cells_of_400_pixels", "image, cells of 400 pixels: would take about",
     _seen_as_image(400), 1000),
],
"qrdqn": [
    ("algorithm_of_ones_own", "algorithm=evil.Agent is not from one of",
     settings({"agent.algorithm": "evil.Agent"})),
    ("class_deep_among_the_arguments", "optimizer_class=evil.Agent is neither a plain",
     _argument(policy_kwargs=[[{"x": [{"optimizer_class": "evil.Agent"}]}]])),
    ("log_folder_among_the_arguments", "agent.arguments.tensorboard_log=",
     _argument(tensorboard_log="{base}/outside")),
    ("settings_nested_as_deep_as_json_goes", "nested too deeply", nested_settings),
    ("ten_million_quantiles", _HUNGRY, _argument(policy_kwargs={"n_quantiles": 10_000_000}), 1000),
],
"lake": [
    ("environment_of_a_module", FINE, world(id="evil:FrozenLake-v1")),
    ("environment_that_opens_a_file", FINE,
     world(id="gridworld:GridWorld-v0", kwargs={"layout": "{base}/secret.txt"})),
    ("environment_of_four_million_cells", FINE,
     world(kwargs={"desc": ["S" + "F" * 1998 + "G"] * 2000}), 1000),
    ("environment_that_a_command_builds", FINE,
     settings({"env": {"source": "built", "builder": "os.system", "kwargs": {"command": _CANARY},
                       "max_episode_steps": None}})),
    ("world_that_is_the_secret", "world.npz: is a symbolic link", linked("world.npz", "{base}/secret.txt")),
    ("world_of_450_megabytes", "world.npz: would take about 1.35 GB", grown("world.npz", 450_000_000)),
    ("world_that_grows", f"{_NO_WORLD} (its members are larger than the file)",
     members("world.npz", {"own_observation.npy": lambda _: npy("|u1", 2 * 10**8) + bytes(2 * 10**8)},
             _PACKED)),
    ("world_whose_header_is_cut_off", f"{_NO_WORLD} (('EOF in multi-line",
     members("world.npz", {"reward.npy": npy_header("((((")})),
    ("world_that_is_pickled", "world.npz: not a world", members("world.npz", {"name.npy": pickled_array})),
    ("world_with_another_digit", "world.npz: is not the world that manifest.json names",
     array("reward", lambda there: np.where(there == 1, 0.5, there))),
    ("world_that_shows_another_digit", "world.npz: is not the file that the run wrote",
     unsealed("world.npz", array("action_names", lambda _: np.array(["a", "b", "c", "e"])))),
],
"sarsa": [
    # a table's files
    ("pickle_in_a_table", "Object arrays cannot be loaded", model(q__npy=pickled_array)),
    ("table_of_a_trillion_numbers", "not a model of sarsa", model(q__npy=npy("<f8", _TRILLION))),
    ("table_that_is_a_bomb", "its members are larger than the file", packed("model.zip", "q.npy", 2**28)),
    ("pickle_as_visits", FINE, file("visits.npy", pickled_array)),
    ("visits_that_are_the_secret", FINE, linked("visits.npy", "{base}/secret.txt")),
    ("visits_whose_header_is_cut_off", FINE, file("visits.npy", npy_header("(((("))),
    # settings
    ("target_among_the_settings", "config.agent: has an unknown key _target_",
     settings({"agent._target_": "os.system", "agent.command": _CANARY})),
    ("interpolation_in_names", "policy of run on ${oc.env:HOME}",
     settings({"agent.name": _SECRET_WORD, "env.layout": "${oc.env:HOME}"})),
    ("interpolation_in_a_number", "must be float", settings({"env.slip": _SECRET_WORD})),
    ("map_file_that_is_the_secret", FINE, settings({"env.layout": "secret.txt"})),
    ("map_file_elsewhere_that_is_the_secret", FINE, world(layout="{base}/secret.txt")),
    ("map_of_a_million_cells", "would take about 1.15 GB of memory", _corridors(1000, 998)),
    ("a_trillion_environments", "n_envs=1000000000000: must be from 1 to", settings({"n_envs": _TRILLION})),
    ("an_episode_of_a_trillion_steps", "env.max_episode_steps=1000000000000: must be from 1 to",
     settings({"env.max_episode_steps": _TRILLION})),
    # the manifest as a file
    ("manifest_of_ten_gigabytes", "manifest.json: is larger than 4 MiB",
     grown("manifest.json", 10 * 2**30)),
    ("manifest_nested_a_hundred_thousand_deep", "manifest.json: is not JSON",
     lambda run, base: (run / "manifest.json").write_text("[" * 100_000 + "]" * 100_000)),
    ("manifest_that_is_the_secret", "manifest.json: is a symbolic link",
     linked("manifest.json", "{base}/secret.json")),
    ("manifest_that_waits_for_a_writer", "manifest.json: is not an ordinary file", waiting("manifest.json")),
    ("names_that_act_on_the_terminal", "config.agent.name='\\x1b]0;owned",
     settings({"agent.name": _ESCAPES})),
    ("names_that_are_no_text", "must be a plain name", settings({"env.layout": "\ud800\x00"})),
    ("a_megabyte_in_a_numbers_place", "config.seed=a list: must be int",
     settings({"seed": ["\x1b"] * 10**5})),
    ("continuations_without_a_step", _RESUMED, said(resumed=[{"total_timesteps": 1}])),
    ("numbers_that_json_has_not", "manifest.json: is not JSON",
     said(reached=float("nan"), seed=float("inf"))),
    # what the report shows
    ("names_that_are_scripts", FINE, settings({"agent.name": _SCRIPT})),
    ("curve_of_a_million_columns", FINE,
     file("curve.csv", lambda _: (",".join(map(str, range(10**6))) + "\n" + "1," * 10**6 + "\n").encode())),
    ("curve_of_millions_of_short_rows", FINE, file("curve.csv", lambda _: b"ab,12\n" * 10_000_000), 1000),
    ("curve_that_waits_for_a_writer", FINE, waiting("curve.csv")),
    ("summary_that_is_the_secret", FINE, linked("summary.json", "{base}/secret.json")),
    ("picture_that_is_the_secret", FINE, linked("policy.png", "{base}/secret.png")),
    ("picture_of_eighty_million_pixels", FINE,
     lambda run, base: (run / "policy.png").write_bytes(png(9_000))),
    ("films_that_are_the_secret", FINE,
     all_of(linked("episode.gif", "{base}/secret.png"), linked("episode.mp4", "/dev/zero"))),
    ("event_of_an_exabyte", FINE, events(lambda: event(b"x", 2**60))),
    # field 5 of a record is its summary, whose field 1 is a value: 20 million empty ones
    ("event_of_many_empty_values", FINE,
     events(lambda: event(b"\x2a\x80\xb4\x89\x13" + b"\n\0" * 20_000_000)), 1000),
    ("events_that_wait_for_a_writer", FINE, waiting("events.out.tfevents.0.a.1")),
    # where things are written
    ("recordings_that_lead_outside", FINE, linked("recording", "{base}/outside")),
    ("frames_that_lead_outside", FINE,
     all_of(guessed_names("frames"), linked("frames", "{base}/outside"))),
    ("files_that_lead_outside", FINE, guessed_names("episode.gif", "policy.png", "visits.png")),
    ("report_that_leads_outside", FINE, linked("report", "{base}/outside")),
    # files that nobody should need
    ("yaml_that_runs_and_grows", FINE, hydra_files),
    ("modules_that_shadow_pythons", FINE, shadowing_modules),
    ("diff_that_is_the_secret", FINE, linked("source.diff", "{base}/secret.txt")),
    # what resume goes on with
    ("mark_of_a_curve_outside", FINE,
     all_of(mark_of_nothing("curve", "curve.csv"), linked("curve.csv", "{base}/outside/kept"))),
    ("mark_of_events_outside", FINE,
     all_of(mark_of_nothing("events", "x"), linked("x", "{base}/outside/kept"))),
    ("mark_of_another_file_of_the_run", FINE, mark_of_nothing("curve", "manifest.json")),
    ("checkpoints_that_lead_outside", FINE, checkpoints_outside),
    ("checkpoint_that_waits_for_a_writer", FINE, waiting(LAST)),
    ("checkpoint_that_is_a_folder", FINE, lambda run, base: (run / LAST).mkdir()),
    ("checkpoint_that_acts_on_the_terminal", FINE,
     newest_checkpoint(b'{"a":{"@":"x"}}', {"\x1b[31m\x1b]0;x\x07.npy": b"x"})),
    ("checkpoint_of_seven_gigabytes", FINE, grown(LAST, 7 * 2**30), 1000),
    ("checkpoint_of_sixty_megabytes_of_json", FINE,
     newest_checkpoint(lambda _: b'{"arrays":[],"state":{"a":[' + b"[],[]," * 10_000_000 + b"[]]}}"), 1000),
    ("checkpoint_of_an_array_that_is_left_out", FINE,
     newest_checkpoint(b'{"a":{"@":"a"}}', {"a.npy": npy("<f8", 30_000_000_000)}), 1000),
],
}
# fmt: on
CATALOGUE = [Hostile(agent, *row) for agent, rows in _ROWS.items() for row in rows]
