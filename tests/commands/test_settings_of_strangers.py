"""Whatever a stranger writes into a setting, no door to a run imports it or contacts a server.

Every text of every schema is in turn the path of a module that leaves a mark where it is imported, and so
does the package of the server. What needs trust somewhere is tried alone, in one run at every door in its
first form, else at two, and all else together.
"""

import contextlib
import dataclasses
import functools
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.hostile import checkpoint, manifest
from helpers.support import CONF, NO_FILES, SHORT, configure, train_in

import gridworld
from gridworld.base.errors import InputError
from gridworld.commands import diagnose, evaluate, export, play, playground, record, report, reproduce, verify
from gridworld.commands.train import resume
from gridworld.config import settings
from gridworld.config.fields import MISSING
from gridworld.config.recipe_file import with_recipe
from gridworld.config.settings import foreign, read_config
from gridworld.config.worlds import SOURCES
from gridworld.run.provenance import identity
from gridworld.run.reader import read_run

EVIL = ("evil.Mark", "evil:Mark-v0")
LAKE = [*NO_FILES, "env=frozen_lake_v1"]
RUNS = {
    "dqn": [*SHORT["dqn"], *LAKE, "total_timesteps=600"],
    "ppo": [*SHORT["ppo"], *LAKE, "total_timesteps=600"],
    "sb3": [*SHORT["a2c"], *LAKE],
    "value_iteration": [*SHORT["value_iteration"], *LAKE],
    "sarsa": [*SHORT["sarsa"], *LAKE, "total_timesteps=600"],
    "map": [*SHORT["sarsa"], *NO_FILES, "total_timesteps=600"],
}
Place = tuple[str, Any]  # a setting's dotted name, and what a stranger writes there

DOORS: dict[str, Callable[[Path], object]] = {
    "open_run": lambda run: gridworld.open_run(run).policy,
    "evaluate": lambda run: evaluate.main([str(run)]),
    "verify": lambda run: verify.main([str(run), "--out", str(run.parent / "certificate.json")]),
    "gridworld.verify": lambda run: gridworld.verify(run),
    "record": lambda run: record.main([str(run), "--format", "png", "policy"]),
    "report": lambda run: report.main([str(run), "--formats"]),
    "export": lambda run: export.main([str(run), "--to", "hub", "--out", str(run.parent / "hub")]),
    "diagnose": lambda run: diagnose.main([str(run), "--try"]),
    "gridworld.diagnose": lambda run: gridworld.diagnose(run, try_offers=True),
    "playground": lambda run: playground.main([str(run), "--out", str(run.parent / "page.html")]),
    "play": lambda run: play.main(["--agent", str(run)]),
    "reproduce": lambda run: reproduce.main([str(run)]),
    "resume": lambda run: resume([f"resume={run}", "total_timesteps=1200"]),  # last, since it writes there
}
TWO = ("open_run", "resume")
TRY = ("diagnose", "gridworld.diagnose")  # which train again
WELL = re.compile("|gridworld play: there is no display.*|.* has no checkpoint to continue from; .*")


def forms(text: str) -> Iterator[Any]:
    """The text, as a setting may have it somewhere in its value."""
    yield [text]
    yield [{"_target_": text}]
    yield dict.fromkeys(("x", "_target_", "env_id", "optimizer_class", "replay_buffer_class"), text)
    yield {"policy_kwargs": {"features_extractor_class": text}}


def texts(content: dict[str, Any]) -> Iterator[Place]:
    """What a stranger may write into these settings of a run: a path at each place, and every switch on."""
    for name, value in settings.flat(content):
        if isinstance(value, bool):
            yield name, True
        elif not isinstance(value, int | float):
            yield from ((name, form) for form in (*EVIL, *forms(EVIL[0])))


def with_settings(run: Path, places: list[Place]) -> bool:
    """Write settings into the manifest, and the checkpoint as its own; False: they have other types."""

    def edit(content: dict[str, Any]) -> None:
        for name, value in places:
            *path, last = name.split(".")
            functools.reduce(dict.__getitem__, path, content["config"])[last] = value

    manifest(run, edit)
    content = json.loads((run / "manifest.json").read_text())
    try:
        own = identity(read_config(content["config"], ""), "\n".join(content["layout"]))
    except InputError:
        return False
    if any((run / "checkpoints").glob("*.state")):
        checkpoint(lambda state: state.update(identity=own))(run, run)
    return True


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    for name, words in RUNS.items():
        train_in(folder / name, *words)
    return folder


@pytest.fixture
def mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that the modules `evil` and `wandb` make where they are imported."""
    code = f"from pathlib import Path\nPath({str(tmp_path / 'mark')!r}).touch()\nclass Mark: pass\n"
    for name in ("evil", "wandb"):
        (tmp_path / f"{name}.py").write_text(code)
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.delitem(sys.modules, "gridworld.training.wandb_log", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.setenv(variable, "")
    return tmp_path / "mark"


def ends(door: str, run: Path, mark: Path, places: object) -> str:
    """How a door ends: "" well, or in a sentence."""
    try:
        DOORS[door](run)
        sentence = ""
    except InputError as error:
        sentence = str(error)
    except SystemExit as ended:
        sentence = "" if ended.code in (0, 1) else f"ended with {ended.code}"
    assert not mark.exists(), (door, places, sentence)
    assert "\n" not in sentence, (door, places)
    return sentence


def edited(run: Path, like: Path, *places: Place) -> bool:
    """Make a copy of a run with these settings, anew; False: they have other types."""
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree(like, run)
    return with_settings(run, json.loads(json.dumps(places)))


CASES = [
    *((name, None) for name in RUNS),
    *(("map" if source == "map" else "sarsa", source) for source in SOURCES),
]


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "source"), CASES)
def test_no_door_runs_what_a_stranger_names(agent: str, source: str | None, good: Path, mark: Path) -> None:
    run, like = mark.parent / "run", good / agent
    content = json.loads((like / "manifest.json").read_text())["config"]
    env, world = content.pop("env"), list[Place]()
    if agent != "dqn":  # with which all other settings are tried
        content = {"agent": content["agent"]}
    if source is not None:
        env = dataclasses.asdict(SOURCES[source]())
        env = {key: "x" if value == MISSING else value for key, value in env.items()}
        content, world = {"env": env}, [("env", env)]
    harmless: dict[str, Any] = {}
    tried = set[str]()  # settings, at every door
    for name, value in texts(content):
        is_readable, is_harmful = edited(run, like, *world, (name, value)), any(foreign({name: value}))
        is_first = is_harmful and name not in tried and agent in ("dqn", "map")
        doors = (DOORS if is_first else TWO) if is_readable else TWO[:1]
        if doors is DOORS:
            tried.add(name)
        refused = [ends(door, run, mark, (name, value)) for door in doors]
        if not is_harmful and not any(refused):
            harmless[name] = value
    edited(run, like, *world, *harmless.items())
    for door in DOORS:
        assert WELL.fullmatch(ends(door, run, mark, harmless)), (door, harmless)


def test_with_trust_the_mark_is_left(good: Path, mark: Path) -> None:
    run = mark.parent / "run"
    edited(run, good / "dqn", ("observation.features", "evil.Mark"))
    with pytest.raises(InputError, match=r"features=evil.Mark is not from .*; add --trust if you trust"):
        gridworld.open_run(run)
    with pytest.raises(InputError, match="must be the import path of a BaseFeaturesExtractor"):
        _ = gridworld.open_run(run, trust=True).policy
    assert mark.exists()


@pytest.mark.slow
def test_no_recipe_runs_what_a_stranger_names(mark: Path) -> None:
    path = mark.parent / "winner.yaml"
    for name in settings.settings_of_a_run():
        for value in (*EVIL, *forms(EVIL[0]), True):
            *sections, last = name.split(".")
            content = functools.reduce(lambda inner, key: {key: inner}, reversed(sections), {last: value})
            path.write_text(json.dumps(content))
            if any(foreign({name: value})):
                with pytest.raises(InputError, match=r"^[^\n]*; add trust=true if you trust its author$"):
                    with_recipe([f"recipe={path}"])
            elif value in (EVIL[0], True):
                with contextlib.suppress(InputError):
                    gridworld.compose(f"recipe={path}")
            assert not mark.exists(), content


def test_no_recipe_chooses_a_file_elsewhere(mark: Path) -> None:
    """Hydra would read it, with interpolations and all."""
    (mark.parent / "evil.yaml").write_text("# @package _global_\ncallbacks: [{_target_: evil.Mark}]\n")
    recipe = mark.parent / "winner.yaml"
    elsewhere = f"{'../' * 20}{mark.parent}/evil"
    recipe.write_text(f"env: {{recipes_of: [{elsewhere}]}}\n")
    with pytest.raises(InputError, match="leads out of the folder of choices; add trust=true"):
        gridworld.compose(f"recipe={recipe}")
    for content in (f"defaults: [{{override /tuned: {elsewhere}}}]\n", f"tuned: {elsewhere}\n"):
        recipe.write_text(content)
        with pytest.raises(InputError, match=r"a recipe chooses|has an unknown key 'tuned'"):
            gridworld.compose(f"recipe={recipe}")


def test_a_resumed_run_that_contacts_a_server_needs_trust(good: Path, mark: Path) -> None:
    run = mark.parent / "run"
    edited(run, good / "dqn", ("logging.wandb", True))
    assert "trust=true" in read_run(run).resume_command({"logging": {"wandb": True}})
    with pytest.raises(InputError, match="wandb=True contacts a server; add trust=true if"):
        resume([f"resume={run}", "total_timesteps=1200"])
    for door in DOORS:  # which contact nobody
        assert door in ("resume", *TRY) or WELL.fullmatch(ends(door, run, mark, ()))


@pytest.mark.parametrize("agent", sorted(file.stem for file in (CONF / "agent").glob("*.yaml")))
def test_the_shipped_settings_need_no_trust(agent: str) -> None:
    for kind in sorted(file.stem for file in (CONF / "observation").glob("*.yaml")):
        with contextlib.suppress(InputError):  # of a pair that does not fit
            config = configure(f"agent={agent}", f"observation={kind}")
            assert not list(foreign(dataclasses.asdict(config)))
