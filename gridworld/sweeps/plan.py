"""From a command line to its jobs: `agent=dqn,ppo seed=range(20)` are forty.

Two jobs are the same if they compose to the same settings, however these were written; the hash of the
settings decides what has been done already. Settings that change nothing about the result (logging,
recording) are not hashed; the map's text is, since a map file can change.

Jobs that can train together are divided into populations; on CUDA only if a number of runs is asked for,
since their numbers then depend on each other.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gridworld.base.errors import InputError
from gridworld.base.processes import file_limit, free_memory, worker_count
from gridworld.base.together import LARGEST
from gridworld.config.compose import drop_hydra, to_config
from gridworld.config.recipes import Chosen, with_recipe_by_rule
from gridworld.config.settings import foreign, has_own_code
from gridworld.config.train import AUTO, TrainConfig
from gridworld.config.words import prepared
from gridworld.config.worlds import each_once
from gridworld.run.provenance import settings_hash
from gridworld.training.setup import check_settings, notes

RUNS_FILES = 4  # that a run has open: its lock, its curve, its events, its log
_SHARE_OF_MEMORY = 4  # a population takes a fourth of what is free, shared by the workers
_RUNS_BYTES = 16 * 2**20  # of a run beside its agent, with its pictures
_OTHER_FILES = 64  # of the process
_FEWEST = 4  # runs of a population for which another core is taken
_MOST_BASES = 64
_NUMBERED = "${hydra.job.num}"  # hydra.sweep.subdir unless it is set; the sweeper has its own names


@dataclass(frozen=True)
class Job:
    """One run of a sweep, as planned from the command line."""

    overrides: tuple[str, ...]
    swept: tuple[str, ...]  # those of the overrides that were given several values
    hash: str  # of the settings that matter
    mistake: str | None  # what is wrong with the settings, as far as it is known before training
    config: TrainConfig
    memory: int = 0  # bytes, about, that it takes while it trains
    notes: tuple[str, ...] = ()  # what to say before training
    # Once it is to run:
    folder: Path = Path()
    replaces: bool = False  # a finished run in the folder, which is not the job's result

    @property
    def shape(self) -> str | None:
        """What must be equal for jobs to train as one population; None: it trains alone."""
        config = self.config
        if config.agent.shape is None or has_own_code(config.callbacks):
            return None
        same = (config.n_envs, config.device, config.threads, config.observation, config.callbacks)
        return repr((config.agent.shape, *same))


def may_fork(config: TrainConfig) -> bool:
    """Whether a run may train in a fork: with only our code and the libraries', on one core."""
    own_code = has_own_code(config.callbacks) or any(foreign({"agent": dataclasses.asdict(config.agent)}))
    return config.device == "cpu" and config.threads == 1 and not own_code


def expand(
    words: Sequence[str], loader: ConfigLoader, most: int, paired: Sequence[Any] = ()
) -> list[tuple[list[str], list[str]]]:
    """Expand a command line to (overrides, the swept ones among them) of every job, the last key fastest.

    Hydra's `loader` knows the groups that `glob` chooses from. There may be `most` jobs. `paired` has keys
    whose values vary together, or groups of such keys.
    """
    lines: dict[str, list[str]] = {}
    swept: dict[str, list[str]] = {}
    for override in OverridesParser.create(config_loader=loader).parse_overrides(list(words)):
        key = override.get_key_element()
        for earlier in (lines, swept):  # given twice, the last one counts, in its place
            earlier.pop(key, None)
        if override.is_sweep_override():
            lines[key] = swept[key] = [f"{key}={value}" for value in _values(override, most)]
        else:
            lines[key] = [str(override.input_line)]
    groups = _groups(paired, swept)
    axes = []  # what varies independently of the rest: of each, {key: line} per value
    for key in lines:
        group = next((group for group in groups if key in group), [key])
        if key == group[0]:
            together = zip(*(lines[each] for each in group), strict=True)
            axes.append([dict(zip(group, values, strict=True)) for values in together])
    if math.prod(map(len, axes)) > most:
        raise InputError(
            f"{' '.join(words)}: more than {most:,} jobs; if you mean that, raise hydra.sweeper.max_jobs"
        )
    found = []
    for parts in itertools.product(*axes):
        job = {key: line for part in parts for key, line in part.items()}
        found.append(([job[key] for key in lines], [job[key] for key in swept]))
    return found


def _values(override: Override, most: int) -> list[str]:
    """The values of a swept key, one too many where there are more than `most`."""
    if not override.is_discrete_sweep():
        raise InputError(f"{override.input_line}: a sweep takes a list, a,b,c, or range(start, stop)")
    values = list(itertools.islice(override.sweep_string_iterator(), most + 1))
    if not values:
        raise InputError(f"{override.input_line}: is empty, so there are no jobs")
    return values


def _groups(paired: Sequence[Any], swept: Mapping[str, list[str]]) -> list[list[str]]:
    """The keys that vary together, each group in the order of the command line."""
    by_name = {key.lstrip("+"): key for key in swept}
    groups = paired if any(map(_is_list, paired)) else [paired]
    found: list[list[str]] = []
    for group in filter(None, groups):
        names = [str(name) for name in (group if _is_list(group) else [group])]
        where = f"hydra.sweeper.paired=[{','.join(names)}]"
        for name in names:
            if name not in by_name:
                raise InputError(f"{where}: {name} has no list of values; add {name}=A,B")
        keys = [key for key in swept if key in {by_name[name] for name in names}]
        if len(keys) < max(2, len(names)) or set(keys) & set(itertools.chain(*found)):
            raise InputError(f"{where}: must name two settings or more, such as [agent,n_envs], each once")
        if len({len(swept[key]) for key in keys}) > 1:
            counts = ", ".join(f"{name} has {len(swept[by_name[name]])}" for name in names)
            raise InputError(f"{where}: lists that vary together must have equal lengths; {counts} values")
        found.append(keys)
    return found


def _is_list(entry: Any) -> bool:
    return isinstance(entry, Sequence) and not isinstance(entry, str)


class Configurations:
    """Composes jobs: by Hydra once per choice of files, whose values are then put into copies.

    Hydra reads every file anew for every job, which takes as long as a short run.
    """

    def __init__(self, loader: ConfigLoader, master: DictConfig) -> None:
        self._loader, self._master, self._shared = loader, master, _shared(master)
        subdir = self._shared["sweep"]["subdir"]
        if subdir != _NUMBERED:
            raise InputError(
                f"hydra.sweep.subdir={subdir}: a sweep names the folders of its jobs by their settings; "
                "leave it out"
            )
        HydraConfig.instance().set_config(master)  # settings may refer to it: ${hydra:runtime.cwd}
        self._base = functools.lru_cache(maxsize=_MOST_BASES)(self._by_hydra)
        self._is_group = functools.cache(lambda key: bool(loader.get_group_options(key)))

    def __call__(self, words: Sequence[str]) -> tuple[TrainConfig, Chosen]:
        """Compose a job's overrides."""
        overrides = OverridesParser.create(config_loader=self._loader).parse_overrides(prepared(words))
        rest = [o for o in overrides if isinstance(o.value(), dict) or not self._is_group(o.key_or_group)]
        # Hydra applies values in their order, after all choices.
        ours = list(itertools.takewhile(_is_value, reversed(rest)))[::-1]
        lines = [str(each.input_line) for each in overrides if each not in ours]
        base, chosen = self._base(*lines)
        settings = copy.deepcopy(base)
        try:
            for override in ours:
                OmegaConf.update(settings, override.key_or_group, override.value())
        except OmegaConfBaseException:
            settings, _ = self._by_hydra(*(str(each.input_line) for each in overrides))  # says what is wrong
        return to_config(settings), chosen

    def _by_hydra(self, *words: str) -> tuple[DictConfig, Chosen]:
        whole = self._loader.load_sweep_config(self._master, list(words))
        for key, value in _shared(whole).items():
            if value != self._shared[key]:
                raise InputError(
                    f"hydra.{key}: is set by only some of the jobs, but all jobs of a sweep share it; give "
                    "it on the command line"
                )
        chosen = Chosen.of(whole.hydra)
        return drop_hydra(whole), chosen


def _is_value(override: Override) -> bool:
    """Whether an override changes a plain value, and nothing else."""
    is_change = override.type is OverrideType.CHANGE and override.package is None
    return is_change and not isinstance(override.value(), dict | list)


def _shared(whole: DictConfig) -> dict[str, Any]:
    """Of Hydra's own part, what all jobs of a sweep have in common, unresolved."""
    own: Any = OmegaConf.to_container(whole.hydra, resolve=False)
    parts = {key: own[key] for key in ("sweep", "sweeper", "launcher", "callbacks", "output_subdir")}
    return parts | {f"job.{key}": own["job"][key] for key in ("chdir", "env_set")}


def plan(
    jobs: Iterable[tuple[list[str], list[str]]],
    configure: Callable[[Sequence[str]], tuple[TrainConfig, Chosen]],
) -> list[Job]:
    """Compose and check the jobs, each once; `jobs` has (overrides, the swept ones among them) of each."""
    world = each_once()
    known: dict[str, tuple[str, ...]] = {}  # notes, which are the same for each seed
    planned: dict[str, Job] = {}
    for given, swept in jobs:
        config, _, added = with_recipe_by_rule(prepared(given), configure, world)
        mistake, layout, memory, said = None, "", 0, tuple[str, ...]()
        try:
            mdp = check_settings(config, world)
            layout, key = mdp.text(), repr(dataclasses.replace(config, seed=0))
            if config.logging.progress and key not in known:
                known[key] = tuple(notes(config, mdp))
            said = known.get(key, ())
            memory = config.agent.memory(mdp.num_states, config.n_envs, config.total_timesteps)
        except InputError as error:
            mistake = str(error)
        digest = settings_hash(dataclasses.asdict(config), layout)
        job = Job((*given, *added), tuple(swept), digest, mistake, config, memory, said)
        first = planned.setdefault(digest, job)
        if other := [word for word in swept if word not in first.swept]:
            shown = " ".join(word for word in first.swept if word not in swept)
            note = f"{' '.join(other)} repeats the runs of {shown}; they run once"
            planned[digest] = dataclasses.replace(first, notes=(*first.notes, note))
    return list(planned.values())


def runs_apart(launcher: str, config: TrainConfig) -> bool:
    """Whether a job runs in another process on this machine, where there are several."""
    return launcher == "joblib" or (launcher == "forks" and may_fork(config))


def populations(
    jobs: Sequence[Job], most: int | None, launcher: str, own: Mapping[str, Any]
) -> list[list[Job]]:
    """Divide jobs into populations of at most so many; None: as many as train faster, and memory holds."""
    shapes: dict[str, list[Job]] = {}
    for job in jobs:
        shapes.setdefault(job.hash if job.shape is None else f"shape {job.shape}", []).append(job)
    found = []
    for members in shapes.values():
        workers = worker_count(own["n_jobs"]) if runs_apart(launcher, members[0].config) else 1
        share = math.ceil(len(members) / workers)
        bounds = [most or LARGEST, (file_limit() - _OTHER_FILES) // RUNS_FILES]
        bounds.append(max(share, _FEWEST) if launcher == "forks" else share)
        bounds.append(own.get("jobs_per_task", len(members)))
        if most is None:
            memory = free_memory() / _SHARE_OF_MEMORY / workers
            bounds.append(int(memory / (_RUNS_BYTES + max(job.memory for job in members))))
        count = math.ceil(len(members) / max(1, min(bounds)))
        if count > workers:
            count = min(len(members), math.ceil(count / workers) * workers)  # so that all end at once
        ends = [len(members) * part // count for part in range(count + 1)]
        found += [members[start:end] for start, end in itertools.pairwise(ends)]
    return found


def largest_population(asked: object) -> int | None:
    """The largest population by the setting, or None. Raises `InputError`."""
    if asked == AUTO:
        return None
    if type(asked) is int and asked >= 1:
        return asked
    raise InputError(
        f"hydra.sweeper.population={asked}: must be the largest number of runs that train together (1: each "
        f"alone), or {AUTO}"
    )
