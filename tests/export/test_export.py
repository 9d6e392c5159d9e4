"""Exports of runs, read back as the programs that they are for read them. No network is used."""

import contextlib
import csv
import dataclasses
import json
import os
import re
import shutil
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.pages import blocks
from helpers.support import NO_FILES, SHORT, script, train_in
from PIL import Image

from gridworld.base.errors import InputError
from gridworld.base.safe_read import sealed
from gridworld.commands import export
from gridworld.report.export.exported_run import read
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import parse
from gridworld.world.sources.arrays import world_bytes
from gridworld.world.sources.storm import drn_lines

NAME, TABLE = "dqn-classic-seed0", "q_learning-classic-seed3"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two finished runs, and one that is not, in `runs`."""
    folder = tmp_path_factory.mktemp("place")
    train_in(folder / "runs" / "dqn", *SHORT["dqn"], "env.slip=0.1", "recording.frames=false")
    train_in(folder / "runs" / "table", *SHORT["q_learning"], "seed=3", "recording.learning=false")
    broken = folder / "runs" / "unfinished"
    broken.mkdir()
    (broken / "manifest.json").write_text('{"status": "running", "config": {}, "layout": []}')
    return folder


def exported(place: Path, to: str, *words: str) -> list[str]:
    """The lines that an export prints; a second one writes nothing again."""
    (place / "home").mkdir(exist_ok=True)
    lines = []
    for _ in range(2):
        done = script("export.py", *words, "--to", to, cwd=place, HOME=str(place / "home"))
        assert done.returncode == 1, done.stderr  # for the one that is not finished
        assert done.stderr.count("\n") == 1, done.stderr
        assert done.stderr.startswith("warning: runs/unfinished"), done.stderr
        lines.append(done.stdout.splitlines())
    assert lines[0] == lines[1]
    return lines[0]


def curve_of(place: Path) -> list[dict[str, str]]:
    with (place / "runs" / "dqn" / "curve.csv").open() as file:
        return list(csv.DictReader(file))


def regrets_of(place: Path) -> list[tuple[int, float]]:
    return [(int(row["step"]), float(row["regret"])) for row in curve_of(place)]


def summary_of(place: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((place / "runs" / "dqn" / "summary.json").read_text())
    return content


@pytest.mark.slow
def test_wandb(place: Path) -> None:
    *told, then = exported(place, "wandb", "runs/dqn", "runs/unfinished", "--project", "mine")
    assert then == "next: wandb sync runs/export/wandb/wandb/offline-run-*"
    folders = list((place / "runs" / "export" / "wandb" / "wandb").glob("offline-run-*"))
    assert len(folders) == len(told) == 1
    folder = place / told[0].removeprefix("runs/dqn: ")
    [file] = folder.glob("*.wandb")
    found: dict[str, list[Any]] = {}
    for record in wandb_records(file):
        kind = record.WhichOneof("record_type")
        found.setdefault(kind, []).append(getattr(record, kind))
    run = found["run"][0]
    assert (run.project, run.display_name, run.run_group) == ("mine", NAME, "dqn-classic")
    assert not run.host
    config = {item.key: json.loads(item.value_json) for item in run.config.update}
    assert config["env.slip"] == 0.1
    assert config["agent.gamma"] == 0.9
    rows = [values_of(each.item) for each in found["history"]]
    curve = curve_of(place)
    assert [row["_step"] for row in rows] == [int(row["step"]) for row in curve]
    for row, line in zip(rows, curve, strict=True):
        assert row["regret"] == float(line["regret"])
        assert ("online_return" in row) == bool(line["online_return"])
    last = rows[-1]
    kinds = {key[9:-6]: value for key, value in last.items() if key.endswith("._type")}
    assert kinds == {
        **dict.fromkeys(("policy.png", "q_error.png", "visits.png"), "image-file"),
        **dict.fromkeys(("learning.gif", "episode.gif"), "video-file"),
    }
    assert all((folder / "files" / last[f"pictures/{name}.path"]).is_file() for name in kinds)
    summary = {key: value for each in found["summary"] for key, value in values_of(each.update).items()}
    assert summary["best_regret"] == summary_of(place)["best_regret"]
    [artifact] = found["artifact"]
    assert (artifact.type, artifact.name) == ("model", NAME)
    for entry in artifact.manifest.contents:
        assert Path(entry.local_path).read_bytes() == (place / "runs" / "dqn" / entry.path).read_bytes()
    assert [entry.path for entry in artifact.manifest.contents] == ["best_model.zip", "model.zip"]


@pytest.mark.slow
def test_wandb_while_it_trains(tmp_path: Path) -> None:
    """Two runs that train together, and an agent of SB3's own loop with W&B's callback."""
    callback = "callbacks=[{_target_: wandb.integration.sb3.WandbCallback, verbose: 0}]"
    done = script("train.py", *SHORT["ppo"], callback, cwd=tmp_path)
    assert "You must call wandb.init() before WandbCallback(); logging.wandb=true calls it" in done.stderr
    words = [*SHORT["ppo"], *NO_FILES, "logging.wandb=true"]
    for more in (
        ["-m", "seed=0,1", "hydra.sweep.dir=runs"],
        ["seed=2", callback, "hydra.run.dir=runs/alone"],
    ):
        done = script("train.py", *more, *words, cwd=tmp_path, HOME=str(tmp_path), WANDB_MODE="offline")
        assert done.returncode == 0, done.stderr
    found = {}
    for file in tmp_path.glob("wandb/offline-run-*/*.wandb"):
        records = list(wandb_records(file))
        rows = [values_of(each.history.item) for each in records if each.HasField("history")]
        [run] = [each.run for each in records if each.HasField("run")]
        found[run.display_name] = {row["step"]: row["eval/regret"] for row in rows if "eval/regret" in row}
        assert any("train/loss" in row for row in rows)
    assert len(found) == 3
    for seed, folder in enumerate(("seed=0", "seed=1", "alone")):
        with (tmp_path / "runs" / folder / "curve.csv").open() as file:
            regrets = {int(row["step"]): float(row["regret"]) for row in csv.DictReader(file)}
        assert found[f"ppo-classic-seed{seed}"] == regrets


def values_of(items: Any) -> dict[str, Any]:
    return {".".join(item.nested_key) or item.key: json.loads(item.value_json) for item in items}


def wandb_records(path: Path) -> Iterator[Any]:
    """The messages in an offline run's file, which is a log as LevelDB writes it."""
    from wandb.proto.wandb_internal_pb2 import Record

    content, place, parts = path.read_bytes(), 7, b""
    assert content[:4] == b":W&B"
    while place + 7 <= len(content):
        left = 2**15 - place % 2**15
        if left < 7:
            place += left
            continue
        _, size, kind = struct.unpack_from("<IHB", content, place)
        parts += content[place + 7 : place + 7 + size]
        place += 7 + size
        if kind in (1, 4):  # whole, or its last part
            yield Record.FromString(parts)
            parts = b""


def exported_and_read(place: Path, to: str, code: str, *words: str) -> tuple[list[str], list[Any]]:
    """Export two runs, twice, and run `code`, in a process, since these packages take seconds to import.

    Returns:
        What the exports print, and what the code does, as JSON.
    """
    program = f"""if True:
        import json, os
        from gridworld.commands.export import main
        for _ in range(2):
            main(["runs/dqn", "runs/table", "--to", {to!r}, *{words!r}])
    """
    environment = {**os.environ, "HOME": str(place)}
    command = [sys.executable, "-W", "ignore", "-c", program + code]
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    *told, found = done.stdout.splitlines()
    assert told[:3] == told[3:]
    return told[:3], json.loads(found)


@pytest.mark.slow
def test_mlflow(place: Path) -> None:
    read = """
        from mlflow import MlflowClient
        client = MlflowClient("sqlite:///store/mlflow.db")
        [experiment] = [each for each in client.search_experiments() if each.name == "gridworld"]
        runs = {run.info.run_name: run for run in client.search_runs([experiment.experiment_id])}
        run = runs["dqn-classic-seed0"]
        key = run.info.run_id
        regret = [(each.step, each.value) for each in client.get_metric_history(key, "regret")]
        files = [f.path for name in ("model", "pictures") for f in client.list_artifacts(key, name)]
        model = open(client.download_artifacts(key, "model/model.zip"), "rb").read().hex()
        about = [run.info.status, run.data.params, run.data.metrics]
        print(json.dumps([sorted(runs), *about, regret, files, model]))
    """
    told, found = exported_and_read(place, "mlflow", read, "--out", "store")
    uri = f"sqlite:///{place}/store/mlflow.db"
    assert told == [
        *(f"runs/dqn: {uri}", f"runs/table: {uri}"),
        f"next: pip install mlflow && mlflow ui --backend-store-uri {uri}",
    ]
    names, status, params, metrics, regret, files, model = found
    assert (names, status) == ([NAME, TABLE], "FINISHED")
    assert (params["env.slip"], params["agent.algorithm"], params["env.num_rows"]) == ("0.1", "DQN", "null")
    summary = summary_of(place)
    assert metrics["best_regret"] == summary["best_regret"]
    assert metrics["sampled.value"] == metrics["sampled_value"] == summary["sampled"]["value"]
    assert sorted({(step, value) for step, value in regret}) == regrets_of(place)
    assert {"model/best_model.zip", "pictures/policy.png", "pictures/episode.gif"} <= set(files)
    assert bytes.fromhex(model) == (place / "runs" / "dqn" / "model.zip").read_bytes()


def test_hub(place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The card is valid, and its code scores what is in the folder as the run did."""
    import huggingface_hub

    *told, then = exported(place, "hub", "runs", "--out", "hub")
    assert told == [f"runs/dqn: hub/{NAME}", f"runs/table: hub/{TABLE}"]
    assert then == f"next: hf upload USER/MODEL hub/{TABLE}"
    monkeypatch.chdir(place)
    for name, run, library in ((NAME, "dqn", "stable-baselines3"), (TABLE, "table", None)):
        folder = place / "hub" / name
        summary = json.loads((place / "runs" / run / "summary.json").read_text())
        card = huggingface_hub.ModelCard.load(folder / "README.md")
        assert card.data.library_name == library
        assert "reinforcement-learning" in card.data.tags
        assert card.data.model_name == ("DQN" if library else "q_learning")
        scores = {each.metric_type: each.metric_value for each in card.data.eval_results}
        assert scores["mean_reward"] == summary["return"]
        assert scores["regret"] == summary["regret"]
        results = json.loads((folder / "results.json").read_text())
        assert results["mean_ep_length"] == summary["length"]
        assert results["sampled.value"] == summary["sampled"]["value"]
        assert json.loads((folder / "config.json").read_text())["seed"] == summary["seed"]
        assert (folder / f"{name[:-6]}.zip").read_bytes() == (place / "runs" / run / "model.zip").read_bytes()
        for picture in re.findall(r"\]\(([\w.]+)\)", card.text):
            with Image.open(folder / picture) as image:
                image.verify()
        assert (folder / "replay.gif").is_file()
        monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda _, there=folder: str(there))
        [code] = blocks(folder / "README.md", "python")
        capsys.readouterr()
        exec(compile(code.text, name, "exec"), {})
        assert f"regret={summary['regret']:.4g}," in capsys.readouterr().out


def test_another_run_of_that_name_gets_a_folder_of_its_own(place: Path) -> None:
    """Which is no proof that the run is in it."""
    (place / "other" / NAME).mkdir(parents=True)
    for _ in range(2):
        done = script("export.py", "runs/dqn", "--to", "hub", "--out", "other", cwd=place)
        assert done.returncode == 0, done.stderr
        [folder] = re.findall(rf"^runs/dqn: (other/{NAME}-[0-9a-f]{{16}})\n", done.stdout)
        assert not list((place / "other" / NAME).iterdir())
        assert (place / folder / "results.json").exists()
        shutil.rmtree(place / folder)
        (place / folder).mkdir()


KILLED_IN = {  # functions, in the order in which an export calls them
    "wandb": ["wandb.Image", "wandb.Run.log", "wandb.Artifact.add_file", "wandb.Run._finish"],
    "mlflow": [
        *("mlflow.store.db.utils._upgrade_db", "mlflow.MlflowClient.create_experiment"),
        *("mlflow.MlflowClient.log_batch", "mlflow.MlflowClient.log_artifact"),
        "mlflow.MlflowClient.set_terminated",
    ],
    "hub": [f"gridworld.report.export.targets.{each}" for each in ("write_text", "write_json")],
}


@pytest.mark.parametrize(
    "to", [*(pytest.param(to, marks=pytest.mark.slow) for to in ("wandb", "mlflow")), "hub"]
)
def test_an_export_that_is_killed_is_whole_after_the_same_command(to: str, place: Path) -> None:
    """Killed in each of these functions, one export after the other."""
    program = f"""if True:
        import os, signal
        from unittest import mock
        from gridworld.commands.export import main
        from gridworld.report.export.targets import TARGETS
        for package in TARGETS[{to!r}].packages:
            __import__(package)

        def kill(*arguments, **options):
            os.kill(os.getpid(), signal.SIGKILL)

        def export(function, *words):
            child = os.fork()
            if child == 0:
                with mock.patch(function, kill) if function else mock.MagicMock():
                    main(["runs/dqn", "--to", {to!r}, *words])
                os._exit(0)
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

        for function in {KILLED_IN[to]}:
            assert export(function, "--out", "killed") == -signal.SIGKILL, function
        for words in (["--out", "killed"], ["--out", "killed"], ["--out", "calm"]):
            assert export("", *words) == 0
    """
    folder = place / f"kills-{to}"
    folder.mkdir()
    (folder / "runs").symlink_to(place / "runs")
    command = [sys.executable, "-W", "ignore", "-c", program]
    environment = {**os.environ, "HOME": str(folder)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert written(folder / "killed") == written(folder / "calm")


def written(out: Path) -> list[tuple[str, int]]:
    """The files of an export without what no two have in common, with their sizes, and MLflow's rows."""
    ids = r"offline-run-\w+-(?=\w+/)|(?<=artifacts/)\w{32}|logs/.*|.*\.(lock|log|db|wandb)$|latest-run.*"
    files = [path for path in sorted(out.rglob("*")) if path.is_file()]
    found = [(re.sub(ids, "", str(path.relative_to(out))), path.stat().st_size) for path in files]
    if (out / "mlflow.db").exists():
        with contextlib.closing(sqlite3.connect(out / "mlflow.db")) as database:
            for table in ("experiments", "runs where status = 'FINISHED'", "runs", "params", "metrics"):
                [(rows,)] = database.execute(f"select count(*) from {table}")
                found.append((table, rows))
    return sorted((name, size) for name, size in found if name)


@pytest.fixture(scope="module")
def lake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on an environment with tables."""
    folder = tmp_path_factory.mktemp("lake") / "run"
    words = ("env=frozen_lake_v1_dry", "recording.frames=false", "recording.learning=false")
    train_in(folder, *SHORT["q_learning"], *words)
    return folder


def as_read(run: Path, copies: Path) -> dict[str, bytes]:
    """The files that any target would get."""
    copies.mkdir()
    found = read(run, copies)
    files = {path.name: path.read_bytes() for path in (*found.models, *found.pictures)}
    return files | {"world.npz": world_bytes(found.mdp)}


def test_only_what_the_manifest_vouches_for_is_exported(lake: Path, tmp_path: Path) -> None:
    found = as_read(lake, tmp_path / "copies")
    assert found.keys() >= {"model.zip", "world.npz", "policy.png", "episode.gif"}
    assert all(content == (lake / name).read_bytes() for name, content in found.items())
    manifest = json.loads((lake / "manifest.json").read_text())
    assert found.keys() <= manifest["sha256"].keys()
    secret = tmp_path / "secret"
    secret.write_text("secret")
    for name, content in found.items():
        run = tmp_path / f"with-{name}" / "run"
        shutil.copytree(lake, run)
        digit = next(at for at in range(len(content) // 2, len(content)) if content[at : at + 1].isdigit())
        other = b"0" if content[digit : digit + 1] != b"0" else b"1"
        (run / name).write_bytes(content[:digit] + other + content[digit + 1 :])
        with pytest.raises(InputError, match=re.escape(f"{run / name}: is not the file that the run wrote")):
            as_read(run, tmp_path / f"changed-{name}")
        for target in (str(secret), "/dev/zero"):
            (run / name).unlink()
            (run / name).symlink_to(target)
            with pytest.raises(InputError, match=re.escape(f"{run / name}: is a symbolic link")):
                as_read(run, tmp_path / f"link-{name}-{Path(target).name}")
    run = tmp_path / "added" / "run"  # to which somebody has added a film
    shutil.copytree(lake, run)
    del manifest["sha256"]["episode.gif"]
    (run / "manifest.json").write_text(json.dumps(sealed(manifest)))
    assert found.keys() - as_read(run, tmp_path / "without").keys() == {"episode.gif"}


def test_a_file_that_the_run_lacks_is_named(
    lake: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names = json.loads((lake / "manifest.json").read_text())["sha256"]
    assert names.keys() >= {"curve.csv", "best_model.zip", "visits.npy", "policy.png", "episode.gif"}
    for name in names:
        shutil.copytree(lake, name)
        Path(name, name).unlink()
        told = rf"{name}: has no {name}$"
        if not name.endswith((".png", ".gif", ".npy", "evaluations.npz")):
            with pytest.raises(InputError, match=told):
                export.main([name, "--to", "hub", "--out", "hub"])
            continue
        with pytest.raises(SystemExit) as ended:
            export.main([name, "--to", "hub", "--out", "hub"])
        assert ended.value.code == 1
        assert re.fullmatch(f"warning: {told}", capsys.readouterr().err.strip())


def test_the_hub_gets_the_tables_of_the_run_and_nothing_of_one_that_was_changed(
    lake: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(lake, "run")
    with Path("run/curve.csv").open("a") as file:
        file.write(" ")
    with pytest.raises(InputError, match=r"run/curve.csv: is not the file that the run wrote"):
        export.main(["run", "--to", "hub", "--out", "hub"])
    assert not Path("hub").exists()
    export.main([str(lake), "--to", "hub", "--out", "hub"])
    [world] = (tmp_path / "hub").glob("*/world.npz")
    assert world.read_bytes() == (lake / "world.npz").read_bytes()


def test_storm(lake: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    export.main([str(lake), "--to", "storm", "--out", "storm"])
    [file] = Path("storm").glob("*.drn")
    head, model = file.read_text().split("@model\n")
    assert head.startswith("@type: MDP\n")
    counts = [int(line) for line in head.splitlines() if line.isdigit()]
    labels: list[list[str]] = []
    rows: list[list[tuple[float, list[tuple[int, float]]]]] = []
    for words in map(str.split, model.splitlines()):
        if words[0] == "state":
            assert int(words[1]) == len(labels)
            labels.append(words[2:])
            rows.append([])
        elif words[0] == "action":
            rows[-1].append((float(words[2].strip("[]")), []))
        else:
            rows[-1][-1][1].append((int(words[0]), float(words[2])))
    assert counts == [len(rows), sum(map(len, rows))] == [16, 64]
    assert labels[0] == ["init"]
    assert labels[15] == ["goal", "over"]
    assert labels[5] == ["trap", "over"]
    values = [0.0] * len(rows)
    for _ in range(3000):
        values = [
            max(paid + 0.99 * sum(chance * values[there] for there, chance in leads) for paid, leads in row)
            for row in rows
        ]
    assert all(sum(chance for _, chance in leads) == pytest.approx(1) for row in rows for _, leads in row)
    assert values[0] == pytest.approx(0.99**5)  # without slip: six steps


@pytest.mark.parametrize("starts", [1, 3])
def test_several_starts_are_a_state_of_their_own_in_storm(starts: int) -> None:
    mdp = compile_mdp(parse("S" * starts + "...G", "map"))
    lines = "".join(drn_lines(mdp)).splitlines()
    begins = [n for n, line in enumerate(lines) if line.startswith("state") and " init" in line]
    if starts == 1:
        assert [lines[n] for n in begins] == ["state 0 init"]
    else:
        assert lines[begins[0] :] == [
            *("state 7 init", "\taction begin [0]"),
            *(f"\t\t{start} : {1 / 3!r}" for start in range(3)),
        ]


@pytest.mark.parametrize("to", ["wandb", "mlflow"])
def test_a_missing_package_is_told(to: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    monkeypatch.setattr("gridworld.report.export.targets.find_spec", lambda name: None)
    told = rf"^--to {to}: {to} is not installed; pip install -e '.*\[{to}\]'$"
    with pytest.raises(InputError, match=told):
        export.main(["runs/dqn", "--to", to, "--out", "nowhere"])
    assert not (place / "nowhere").exists()


def test_a_failure_of_a_package_is_one_sentence(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> str:
        raise RuntimeError("file is\nnot a database")

    monkeypatch.chdir(place)
    monkeypatch.setitem(export.TARGETS, "hub", dataclasses.replace(export.TARGETS["hub"], write=fail))
    with pytest.raises(InputError, match=r"^runs/dqn: --to hub failed: .*file is not a database$"):
        export.main(["runs/dqn", "--to", "hub", "--out", "bad"])
