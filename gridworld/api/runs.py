"""Training from Python, a finished run opened again, and why it is not optimal."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import cached_property
from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import Agent
from gridworld.api.settings import Override, words
from gridworld.base.console import tell
from gridworld.base.errors import InputError, failure
from gridworld.base.signals import Interrupted
from gridworld.base.user_input import as_path, limited
from gridworld.config.compose import compose as compose_words
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import World, each_once
from gridworld.diagnosis import verdict
from gridworld.diagnosis.evidence import Evidence
from gridworld.envs.rendering import Frame
from gridworld.run import console as run_summary
from gridworld.run.folder import check_inside, claimed
from gridworld.run.reader import check_free, is_started, read_columns
from gridworld.training.resume import unfinished_of
from gridworld.training.saved_run import SavedRun, read_visits
from gridworld.training.setup import without_pictures
from gridworld.training.train import train as train_in
from gridworld.visualization.files import encode_png
from gridworld.visualization.picture import Subject, drawer
from gridworld.world.evaluation import Evaluator, PolicySnapshot

if TYPE_CHECKING:  # of most runs nothing is drawn
    from PIL import Image

    from gridworld.report.chart import NotebookFigure

Curve = dict[str, NDArray[Any]]

_ONE_AT_A_TIME = threading.RLock()  # SB3 and torch draw from generators of the whole process
_KINDS: dict[str, type] = {"step": np.int64, "certified": np.bool_, "sampled_certified": np.bool_}


class RunResult:
    """A finished run: what `train` returns, and `open_run` reads from a folder. A notebook shows it.

    Attributes:
        config: every setting of the run.
        summary: the content of `summary.json`: `certified`, `regret`, `value`, `optimal_value`, ...
        curve: the learning curve. {column: (evaluations,)}; the columns are those of `curve.csv`: `step`,
            `value`, `regret`, `certified`, ..., of the greedy policy, `sampled_value`, ... of the one that
            it explores with, and `online_return`, NaN where no episode ended.
        visits: (S, A), int64, how often training took each action in each state.
        evaluator: scores any policy of the run's world, and has its optimum in `solution`.
        folder: the run's folder; None: it was trained without one.
        saved: the run's files, as far as they were read.
    """

    def __init__(self, saved: SavedRun, folder: Path | None, agent: Callable[[], Agent]) -> None:
        """Read an opened run's files; `folder` is None if it will not stay, `agent` gives the trained one."""
        self.config: TrainConfig = saved.config
        self.summary: dict[str, Any] = saved.run.read_summary()
        self.curve: Curve = {
            name: column.astype(_KINDS.get(name, np.float64))
            for name, column in read_columns(saved.run).items()
        }
        self.visits = read_visits(saved.run, saved.mdp.next_state.shape[:2])
        self.folder = folder
        self.saved = saved
        self._make_agent = agent

    @cached_property
    def evaluator(self) -> Evaluator:
        """Scores any policy of the run's world."""
        return self.saved.evaluator()

    @cached_property
    def policy(self) -> PolicySnapshot:
        """What was learned, as tables `greedy` (S,), `sampled` (S, A), `values` (S,), `q` (S, A) or None."""
        return self.agent.snapshot()

    @property
    def model(self) -> Any:
        """The model, an object of SB3's class; of a tabular agent its table Q, (S, A), float64.

        After `open_run` it has the trained weights, and neither a replay buffer nor the optimiser's state.
        """
        return self.agent.model

    @property
    def overrides(self) -> list[str]:
        """The settings that its command line or call changed, as words."""
        return self.saved.overrides

    @cached_property
    def agent(self) -> Agent:
        """The trained agent, which has the model."""
        return self._make_agent()

    def plot(self, metric: str = "value") -> NotebookFigure:
        """Draw the exact learning curve of both policies next to the optimum, as a figure of matplotlib.

        Args:
            metric: one that `curve` has of both: "value", "regret", "return", "length", "certified", ...

        Raises:
            InputError: there is no such metric.
        """
        from gridworld.report.agent_charts import run_chart  # here, with matplotlib

        return run_chart(metric, self.curve, self.evaluator, self.summary).figure

    def policy_map(self, cell_size: int | None = None) -> Image.Image:
        """Draw its values and greedy actions, as in `policy.png`, as a picture of Pillow; cells in pixels."""
        from PIL import Image

        shown = self.config, False, self.evaluator, self.policy, self.summary["timesteps"], self.visits
        return Image.fromarray(cast(Frame, drawer("maps.policy")(Subject(*shown))(cell_size)))

    def _repr_html_(self) -> str:
        """Its verdict, learning curve and policy."""
        pictures = [self.plot()._repr_png_()]
        with contextlib.suppress(InputError):  # the world is too large for a map
            pictures.append(encode_png(np.asarray(self.policy_map())))
        sources = (f"data:image/png;base64,{base64.b64encode(each).decode()}" for each in pictures)
        images = "".join(f'<img src="{each}" style="max-width:100%;max-height:340px"> ' for each in sources)
        why = "" if self.summary["certified"] else "; gridworld.diagnose(run) says why"
        sentence, scope = run_summary.verdict(self.summary), run_summary.scope_of(self.summary)
        known = f"<br>world: {escape(scope)}" if scope else ""
        return f"<p>{escape(repr(self))}<br><b>{escape(sentence)}</b>{why}{known}</p>{images}"

    def __repr__(self) -> str:
        summary = self.summary
        since = summary["certified_since_step"]
        end = f"regret {summary['regret']:.3g}" if since is None else f"certified since step {since:,}"
        where = "" if self.folder is None else f", folder={str(self.folder)!r}"
        return (
            f"RunResult({summary['agent']} on {summary['env']}, seed {summary['seed']}: "
            f"{summary['timesteps']:,} steps, {end}{where})"
        )


def train(
    *overrides: Override,
    folder: str | PathLike[str] | None = None,
    progress: bool | None = None,
    **settings: Any,
) -> RunResult:
    """Train an agent and score it exactly, as the command `train.py` does: the same seed, the same numbers.

    Calls in several threads run one after the other. In the main thread, Ctrl-C stops training as it stops
    the command: a run with a folder is saved first, and the same call goes on with it.

    Args:
        overrides: words as on the command line, `"agent=dqn"`, or dictionaries, `{"agent.gamma": 0.9}`.
        folder: where the run's files go, an ordinary run for all commands. It must be new, or hold this
            run unfinished. None: nothing stays on disk, and no pictures are drawn.
        progress: whether to show progress; None: as `logging.progress` says, which is to show it.
        settings: settings whose name has no dot, `seed=3`, `total_timesteps=20_000`.

    Returns:
        The run's summary, learning curve, model and policy.

    Raises:
        InputError: a mistake in the settings or the folder; found before training, unless it diverges.
        KeyboardInterrupt: Ctrl-C.
        SystemExit: SIGTERM.

    Example:
        >>> run = train("agent=q_learning", "env=four_rooms", seed=0, progress=False)
        >>> run.summary["certified"], run.model.shape
        (True, (121, 4))
    """
    given = words(*overrides, **settings)
    world = each_once()  # compiled for the choice of a recipe, and to train in
    config = compose_words(given, world)
    if progress is not None:
        config.logging.progress = progress
    with _ONE_AT_A_TIME, _torch_threads_kept(), _as_python_interrupts(folder is not None):
        if folder is None:
            return _train_without_files(config, given, world)
        path = as_path("train: folder", folder)
        check_inside(path.absolute(), "folder")
        check_free(path, "folder")
        try:
            with claimed(path.absolute()):
                return _finished(path.absolute(), config, given, path, world)
        except OSError as error:
            raise InputError(failure(error)) from None


def open_run(folder: str | PathLike[str], trust: bool = False) -> RunResult:
    """Open a finished run. Its files are read as data; the model is built when it is first asked for.

    Args:
        folder: the run's folder.
        trust: import the classes that the run's settings name, wherever they are from.

    Returns:
        The run, as `train` returned it.

    Raises:
        InputError: the folder holds no finished run, one of its files was changed, or it would take more
            memory than the budget, `GRIDWORLD_BUDGET`, usually 1 GB.

    Example:
        >>> open_run("runs/mine").policy.greedy.shape
        (30,)
    """
    path = as_path("open_run: folder", folder)
    with limited():
        saved = SavedRun(path, trust)
        return RunResult(saved, path, saved.agent)


def diagnose(
    run: RunResult | str | PathLike[str], try_offers: bool = False, trust: bool = False
) -> verdict.Diagnosis:
    """Say why a run is not optimal: its regret by state, the causes, and what to try.

    Args:
        run: what `train` or `open_run` returned, or the folder of a finished run.
        try_offers: train what there is to try, until one is certified: `tried` has the results. The new runs
            are in the folder `RUN-tried`; of a run without a folder they do not stay.
        trust: import the classes that the run's settings name, wherever they are from.

    Returns:
        The diagnosis; without causes for a run that is certified optimal.

    Raises:
        InputError: the folder holds no finished run, or one of its files was changed; it would take more
            memory than the budget, `GRIDWORLD_BUDGET`, usually 1 GB; or its settings name classes from
            elsewhere, and are not trusted.

    Example:
        >>> import gridworld
        >>> run = gridworld.train("agent=q_learning", "agent.learning_rate=0.001", progress=False)
        >>> found = gridworld.diagnose(run)
        >>> found.cause, bool(abs(found.split.cost.sum() - found.split.score.regret) < 1e-9)
        ('slow', True)
    """
    with _torch_threads_kept(), limited():
        if isinstance(run, RunResult):
            folder, saved = run.folder, run.saved
            words = None if saved.omission else run.overrides
            evidence = Evidence(
                run.config, words, run.curve, run.visits, run.evaluator, run.agent, run.policy
            )
        else:
            folder = as_path("diagnose: run", run)
            saved = SavedRun(folder, trust)
            evidence = Evidence.of(saved)
        found = verdict.diagnose(evidence)
        if not try_offers:
            if saved.omission:
                tell(saved.omission)
            return found
        verdict.check_trusted(saved, found, trust)
        with tempfile.TemporaryDirectory(prefix="gridworld-") as elsewhere:
            place = Path(elsewhere) if folder is None else verdict.trials_folder(folder)
            return dataclasses.replace(found, tried=tuple(verdict.try_offers(saved, found, place, trust)))


def _train_without_files(config: TrainConfig, given: list[str], world: World) -> RunResult:
    plain = without_pictures(config)
    quiet = dataclasses.replace(
        plain,
        logging=dataclasses.replace(plain.logging, tensorboard=False),
        checkpoint=dataclasses.replace(plain.checkpoint, every=None),
    )
    with tempfile.TemporaryDirectory(prefix="gridworld-", ignore_cleanup_errors=True) as place:
        result = _finished(Path(place), quiet, given, None, world)
    result.config = config
    return result


def _finished(
    place: Path, config: TrainConfig, given: list[str], folder: Path | None, world: World
) -> RunResult:
    agents: list[Agent] = []
    if is_started(place):
        unfinished_of(place, config, world).resume(on_built=agents.append)
    else:
        train_in(config, place, given, world, on_built=agents.append)
    with limited(is_own=True):
        result = RunResult(SavedRun(place, trust=True), folder, agents.pop)
        _ = result.policy, result.evaluator  # before the model is trained further, or the folder is gone
    return result


@contextlib.contextmanager
def _as_python_interrupts(is_kept: bool) -> Iterator[None]:
    try:
        yield
    except Interrupted as interruption:
        how = "; make the same call to resume" if is_kept else ""
        if interruption.exit_code == 128 + signal.SIGINT:
            raise KeyboardInterrupt(f"{interruption}{how}") from None
        raise SystemExit(interruption.exit_code) from None


@contextlib.contextmanager
def _torch_threads_kept() -> Iterator[None]:
    """Give the caller's torch its number of threads back, which a run sets for the whole process."""
    torch: Any = sys.modules.get("torch")
    before = None if torch is None else torch.get_num_threads()
    try:
        yield
    finally:
        if torch is not None:
            torch.set_num_threads(before)
