"""Nothing is written or removed through a symbolic link in a folder that may be a stranger's."""

from pathlib import Path

import pytest
from helpers.support import SHORT, configure, script

from gridworld.base.atomic_write import check_no_links, inside, is_locked
from gridworld.base.errors import InputError
from gridworld.config.train import TrainConfig
from gridworld.run.folder import alone_in
from gridworld.run.reader import check_free
from gridworld.sweeps.folder import SweepFolder
from gridworld.sweeps.plan import Job
from gridworld.sweeps.tune import confirmation as confirm
from gridworld.sweeps.tune.study import check_study_folder

REFUSED = "is a symbolic link, which is not written through; remove it"


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """The reader's own folder: twenty runs."""
    for seed in range(20):
        (tmp_path / "victim" / f"trial=1,seed={seed}" / "deep").mkdir(parents=True)
        (tmp_path / "victim" / f"trial=1,seed={seed}" / "model.zip").write_text("mine")
    return tmp_path / "victim"


def link_to(target: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target)


def contents(folder: Path) -> dict[str, bytes | None]:
    return {str(path): path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


@pytest.mark.parametrize("names", [("a",), ("a", "trial=1,seed=0"), ("real", "a"), ("real", "a", "new")])
def test_a_link_below_is_not_gone_through(names: tuple[str, ...], tmp_path: Path, victim: Path) -> None:
    (tmp_path / "top" / "real").mkdir(parents=True)
    for place in ("a", "real/a"):
        (tmp_path / "top" / place).symlink_to(victim)
    (tmp_path / "named").symlink_to(tmp_path / "top")  # who names a link means where it leads
    for top in (tmp_path / "top", tmp_path / "named"):
        assert inside(top, "real", "new") == top / "real" / "new"
        for refuses in (inside, check_no_links):
            with pytest.raises(InputError, match=f"{top}.*/a: {REFUSED}"):
                refuses(top, *names)
        with pytest.raises(InputError, match=REFUSED):
            check_no_links(top, *names[: names.index("a")])


@pytest.mark.parametrize("link", ["confirm", "confirm/default,00000000,seed=3"])
def test_confirming_takes_no_folder_away_through_a_link(link: str, tmp_path: Path, victim: Path) -> None:
    link_to(victim, tmp_path / "study" / link)
    before = contents(victim)
    place = tmp_path / "study" / "confirm" / "default,00000000,seed=3"
    run = Job((), (), "0" * 32, None, configure(), folder=place)
    with pytest.raises(InputError, match=REFUSED):
        confirm.prepare(tmp_path / "study", [run])
    with pytest.raises(InputError, match=REFUSED):
        confirm.run_held_out([run])
    assert contents(victim) == before


def test_what_an_earlier_winner_left_goes_and_links_go_alone(tmp_path: Path, victim: Path) -> None:
    runs = tmp_path / "study" / "confirm"
    for name in ("trial=2,11111111,seed=3", "notes"):
        (runs / name).mkdir(parents=True)
    (runs / "trial=3,22222222,seed=3").symlink_to(victim)
    before = contents(victim)
    confirm.prepare(tmp_path / "study", [])
    assert [path.name for path in runs.iterdir()] == ["notes"]
    assert contents(victim) == before


@pytest.mark.parametrize("name", ["confirm", "experiment", "experiment/winner.yaml", "study.db"])
def test_a_study_with_a_link_is_refused_before_anything(name: str, tmp_path: Path, victim: Path) -> None:
    link_to(victim, tmp_path / "study" / name)
    with pytest.raises(InputError, match=f"study/{name}: {REFUSED}"):
        check_study_folder(tmp_path / "study")


@pytest.mark.parametrize("link", ["", ".hydra", ".hydra/config.yaml"])
def test_a_sweep_with_a_job_that_leads_elsewhere_is_refused(link: str, tmp_path: Path, victim: Path) -> None:
    sweep = tmp_path / "sweep"
    jobs = [Job((f"seed={seed}",), (f"seed={seed}",), str(seed) * 32, None, TrainConfig()) for seed in (0, 1)]
    folder = SweepFolder(sweep)
    with folder.at_work():
        folder.add(jobs[:1], ["seed=0"])
    link_to(victim, sweep / "seed=0" / link)
    before = contents(victim)
    with pytest.raises(InputError, match=REFUSED):
        SweepFolder(sweep).check(jobs, extend=False)
    (sweep / "seed=1").symlink_to(victim)  # no job of the sweep's has it, and none gets it
    folder = SweepFolder(sweep)
    assert [job.folder.name for job in folder.add(jobs[1:], ["seed=1"])] != ["seed=1"]
    assert contents(victim) == before


def test_hydra_writes_nothing_through_a_link(tmp_path: Path, victim: Path) -> None:
    link_to(victim / "trial=1,seed=0" / "model.zip", tmp_path / "run" / ".hydra" / "config.yaml")
    before = contents(tmp_path)
    done = script("train.py", *SHORT["sarsa"], "hydra.run.dir=run", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: run/.hydra/config.yaml: {REFUSED}\n"
    assert contents(tmp_path) == before


def test_a_lock_or_checkpoints_that_are_a_link_are_refused(tmp_path: Path, victim: Path) -> None:
    link_to(victim / "trial=1,seed=0" / "model.zip", tmp_path / "run" / ".lock")
    before = contents(victim)
    with pytest.raises(InputError, match=rf"run/\.lock: {REFUSED}"), alone_in(tmp_path / "run"):
        pass
    with pytest.raises(InputError, match=r"run/\.lock: is a symbolic link"):
        is_locked(tmp_path / "run" / ".lock")
    link_to(victim, tmp_path / "new" / "checkpoints")
    with pytest.raises(InputError, match=f"new/checkpoints: {REFUSED}"):
        check_free(tmp_path / "new")
    assert contents(victim) == before
