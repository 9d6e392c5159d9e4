"""From a command line to its jobs: `agent=dqn,ppo seed=range(20)` are forty.

Two jobs are the same if they compose to the same settings, however these were written; the hash of the
settings decides what has been done already. Settings that change nothing about the result (logging,
recording) are not hashed; the map's text is, since a map file can change.

Jobs that can train together are divided into populations; on CUDA only if a number of runs is asked for,
since their numbers then depend on each other.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig

from gridworld.config.presets import with_preset
from gridworld.config.settings import foreign, has_own_code
from gridworld.config.sweep import SweepConfig
from gridworld.config.train import AUTO, TrainConfig
from gridworld.config.worlds import EnvConfig
from gridworld.errors import InputError
from gridworld.process.processes import file_limit, free_memory, worker_count
from gridworld.process.together import LARGEST
from gridworld.run.provenance import settings_hash
from gridworld.training.setup import check_settings, notes
from gridworld.world.mdp import Mdp

RUNS_FILES = 4  # that a run has open: its lock, its curve, its events, its log
_SHARE_OF_MEMORY = 4  # a population takes a fourth of what is free, shared by the workers
_RUNS_BYTES = 16 * 2**20  # of a run beside its agent, with its pictures
_OTHER_FILES = 64  # of the process
_FEWEST = 4  # runs of a population for which another core is taken
_LONGEST_NAME = 100  # characters of a job's folder
_MOST_VALUES = 1_000_000  # of one key
_HASH_SHOWN = 6  # characters of the hash in a name that needs it
_SEED = re.compile(r"\+*seed=")


@dataclass(frozen=True)
class Job:
    """One run of a sweep, as planned from the command line."""

    overrides: tuple[str, ...]
    swept: tuple[str, ...]  # those of the overrides that were given several values
    hash: str  # of the settings that matter
    mistake: str | None  # what is wrong with the settings, as far as it is known before training
    config: TrainConfig
    shape: str | None = None  # equal for jobs that can train as one population; None: it trains alone
    memory: int = 0  # bytes, about, that it takes while it trains
    in_fork: bool = False  # whether it may run in a fork of the process that plans it
    notes: tuple[str, ...] = ()  # what to say before training


def expand(
    words: Sequence[str], loader: ConfigLoader, most: int, paired: Sequence[Any] = ()
) -> list[tuple[list[str], list[str]]]:
    """Expand a command line to (overrides, the swept ones among them) of every job.

    The last key changes fastest.

    Args:
        words: the command line's overrides.
        loader: Hydra's, which knows the groups that `glob` chooses from.
        most: how many jobs are allowed.
        paired: keys whose values vary together, or groups of such keys.
    """
    columns: dict[str, tuple[bool, list[str]]] = {}
    for override in OverridesParser.create(config_loader=loader).parse_overrides(list(words)):
        key = override.get_key_element()
        columns.pop(key, None)  # given twice, the last one counts, in its place
        if override.is_sweep_override():
            columns[key] = True, [f"{key}={value}" for value in _values(override)]
        else:
            columns[key] = False, [str(override.input_line)]
    axes = list(_axes({key: lines for key, (_, lines) in columns.items()}, _groups(paired, columns)))
    count = math.prod(map(len, axes))
    if count > most:
        raise InputError(
            f"{' '.join(words)}: {count:,} jobs; if so many are meant, add hydra.sweeper.max_jobs={count}"
        )
    swept = [key for key, (is_swept, _) in columns.items() if is_swept]
    jobs = (dict(itertools.chain(*(part.items() for part in parts))) for parts in itertools.product(*axes))
    return [([job[key] for key in columns], [job[key] for key in swept]) for job in jobs]


def _groups(paired: Sequence[Any], columns: Mapping[str, tuple[bool, list[str]]]) -> list[list[str]]:
    """The keys that vary together, each group in the order of the command line."""
    by_name = {key.lstrip("+"): key for key in columns}
    groups = paired if any(map(_is_list, paired)) else [paired]
    found: list[list[str]] = []
    for group in filter(None, groups):
        names = [str(name) for name in (group if _is_list(group) else [group])]
        where = f"hydra.sweeper.paired=[{','.join(names)}]"
        if len(names) < 2:
            raise InputError(f"{where}: names one setting; a pair is of two or more, such as [agent,n_envs]")
        for name in names:
            if name not in by_name or not columns[by_name[name]][0]:
                raise InputError(f"{where}: {name} has no list of values; give it one, {name}=A,B")
            if names.count(name) > 1 or any(by_name[name] in earlier for earlier in found):
                raise InputError(f"{where}: {name} is paired already; name it once")
        counts = [f"{name} has {len(columns[by_name[name]][1])}" for name in names]
        if len({count.rpartition(" ")[2] for count in counts}) > 1:
            raise InputError(
                f"{where}: lists that vary together are equally long; {', '.join(counts)} values"
            )
        found.append([key for key in columns if key in {by_name[name] for name in names}])
    return found


def _is_list(entry: Any) -> bool:
    return isinstance(entry, Sequence) and not isinstance(entry, str)


def _axes(columns: Mapping[str, list[str]], groups: Sequence[list[str]]) -> Iterator[list[dict[str, str]]]:
    """What varies independently of the rest: of each, {key: line} per value."""
    for key in columns:
        group = next((group for group in groups if key in group), [key])
        if key == group[0]:
            yield [
                dict(zip(group, lines, strict=True))
                for lines in zip(*(columns[each] for each in group), strict=True)
            ]


def _values(override: Override) -> list[str]:
    if not override.is_discrete_sweep():
        raise InputError(f"{override.input_line}: jobs are made of a list, a,b,c, or of range(start, stop)")
    values = list(itertools.islice(override.sweep_string_iterator(), _MOST_VALUES + 1))
    if len(values) > _MOST_VALUES:
        raise InputError(f"{override.input_line}: more than {_MOST_VALUES:,} values; a sweep takes fewer")
    if not values:
        raise InputError(f"{override.input_line}: there is nothing in it, so there would be no job")
    return values


def plan(
    jobs: Iterable[tuple[list[str], list[str]]], configure: Callable[[Sequence[str]], TrainConfig]
) -> list[Job]:
    """Compose and check the jobs, each once; `jobs` has (overrides, the swept ones among them) of each."""
    worlds: dict[str, Mdp] = {}

    def world(env: EnvConfig) -> Mdp:
        key = repr(env)
        if key not in worlds:
            worlds[key] = env.compile()
        return worlds[key]

    known: dict[str, tuple[str, ...]] = {}

    def noted(config: TrainConfig, mdp: Mdp) -> tuple[str, ...]:
        key = repr(dataclasses.replace(config, seed=0))
        if config.logging.progress and key not in known:
            known[key] = tuple(notes(config, mdp))
        return known.get(key, ())

    planned: dict[str, Job] = {}
    for given, swept in jobs:

        def compose(words: list[str], given: list[str] = given) -> TrainConfig:
            return configure([*given, *words])

        config, chosen = with_preset(compose([]), given, compose, world)
        said: tuple[str, ...] = ()
        mistake, layout, memory = None, "", 0
        try:
            mdp = check_settings(config, world)
            layout, said = mdp.text(), noted(config, mdp)
            memory = config.agent.memory(mdp.num_states, config.n_envs, config.total_timesteps)
        except InputError as error:
            mistake = str(error)
        digest = settings_hash(dataclasses.asdict(config), layout)
        planned.setdefault(
            digest,
            Job(
                overrides=(*given, *chosen),
                swept=tuple(swept),
                hash=digest,
                mistake=mistake,
                config=config,
                shape=shape(config),
                memory=memory,
                in_fork=_in_fork(config),
                notes=said,
            ),
        )
    return list(planned.values())


def _in_fork(config: TrainConfig) -> bool:
    """Whether it has only our code and the libraries', and trains on one core."""
    classes = foreign({"agent": dataclasses.asdict(config.agent)})
    own_code = has_own_code(config.callbacks) or any(classes)
    return config.device == "cpu" and config.threads == 1 and not own_code


def shape(config: TrainConfig) -> str | None:
    """What must be equal for runs to train as one population; None: it trains alone."""
    if config.agent.shape is None or has_own_code(config.callbacks):
        return None
    same = (config.n_envs, config.device, config.threads, config.observation, config.callbacks)
    return repr((config.agent.shape, *same))


def folder_name(job: Job, taken: Collection[str], common: Collection[str] = ()) -> str:
    """A name for the job's folder, of the overrides in which it differs from other jobs.

    It is of the swept overrides, or else of all but the common ones; where neither is short enough and free,
    it ends with a part of the hash. The seed is always in it.
    """
    for lines in (job.swept or job.overrides, [line for line in job.overrides if line not in common]):
        name = ",".join(map(_slug, lines)) or "job"
        if len(name) <= _LONGEST_NAME and name.lower() not in taken:
            return name
    lines = job.swept or job.overrides
    seed = [_slug(line) for line in lines if _SEED.match(line)]
    head = ",".join(_slug(line) for line in lines if not _SEED.match(line))
    for characters in (_HASH_SHOWN, len(job.hash)):
        ending = ",".join([*seed, job.hash[:characters]])
        name = ",".join(filter(None, [head[: _LONGEST_NAME - len(ending) - 1].rstrip(",.-"), ending]))
        if name.lower() not in taken:
            break
    return name


def _slug(override: str) -> str:
    """The override in letters, digits and a few safe signs; of a path, its last part."""
    key, equals, value = override.partition("=")
    if "/" in value:
        value = PurePath(value.strip("'\"")).stem
    return re.sub(r"[^A-Za-z0-9_.=+-]+", "-", key + equals + value).strip("-.+~")


def populations(
    jobs: Sequence[Job], settings: SweepConfig, launcher: str, own: Mapping[str, Any], hydra: DictConfig
) -> list[list[Job]]:
    """Divide jobs into populations."""
    workers = worker_count(own["n_jobs"]) if launcher in ("forks", "joblib") else 1
    memory = free_memory() / _SHARE_OF_MEMORY / workers
    shapes: dict[str, list[Job]] = {}
    for job in jobs:
        shapes.setdefault(job.hash if job.shape is None else f"shape {job.shape}", []).append(job)
    most = _most(settings)
    if runs_in_turn(settings, hydra):
        most = 1
    found = []
    for members in shapes.values():
        in_this_process = launcher == "forks" and not any(job.in_fork for job in members)
        share = len(members) if most and in_this_process else math.ceil(len(members) / workers)
        bounds = [most or LARGEST, (file_limit() - _OTHER_FILES) // RUNS_FILES]
        bounds.append(max(share, _FEWEST) if launcher == "forks" else share)
        if most is None:
            bounds.append(int(memory / (_RUNS_BYTES + max(job.memory for job in members))))
        bounds.append(own.get("jobs_per_task", len(members)))
        count = math.ceil(len(members) / max(1, min(bounds)))
        if count > workers:
            count = min(len(members), math.ceil(count / workers) * workers)  # so that all end at once
        ends = [len(members) * part // count for part in range(count + 1)]
        found += [members[start:end] for start, end in itertools.pairwise(ends)]
    return found


def runs_in_turn(settings: SweepConfig, hydra: DictConfig) -> bool:
    """Whether jobs cannot train together: the first failure counts, or each has a current folder."""
    return bool(settings.stop_at_first_failure or hydra.job.chdir)


def _most(settings: SweepConfig) -> int | None:
    """The largest population that is asked for; None: as many as train faster, and memory holds."""
    asked = settings.population
    if asked == AUTO:
        return None
    if type(asked) is int and asked >= 1:
        return asked
    raise InputError(
        f"hydra.sweeper.population={asked}: must be the number of runs that train together at most, 1 for "
        f"each by itself, or {AUTO}"
    )
