"""Running a job as Hydra's `run_job` does, in a fifth of the time.

Hydra copies a job's configuration five times and writes all of it as YAML, most of which is the same for all
jobs of a sweep: 20 ms, as long as the training of a table. Here it is copied once, and each entry's YAML is
made once per process. Files, variables and callbacks are Hydra's, which tests/sweep/test_hydra_job.py checks.
"""

from __future__ import annotations

import gc
import itertools
import os
import pickle
from pathlib import Path
from typing import Any, cast

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobRuntime, JobStatus, _flush_loggers, configure_log, env_override
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf._utils import get_omega_conf_dumper

from gridworld.process.memory_budget import collect_less_often
from gridworld.training.together import Training

_MOST_ENTRIES = 4096

_jobs = itertools.count()  # that began in this process

_entries: dict[tuple[object, ...], str] = {}  # YAML by what it is of


def job(
    task_function: TaskFunction,
    config: DictConfig,
    job_dir_key: str,
    job_subdir_key: str,
    hydra_context: HydraContext,
    configures_logging: bool = True,
) -> Training[JobReturn]:
    """Run a job.

    Args:
        task_function: takes the job's settings; its attribute `training`, if any, makes a generator of them.
        config: all of its configuration, which nobody else uses.
        job_dir_key: where the configuration has the sweep's folder.
        job_subdir_key: where it has the job's, in there.
        hydra_context: of the application.
        configures_logging: as the configuration has it.

    Returns:
        What it came to; an `Exception` that it raised is in there. It has no configurations, which would fill
        the memory of a long sweep.
    """
    collect_less_often()  # in a worker too
    if not config.hydra.sweeper.get("together"):  # which stands for several, and begins before them
        _spare_the_collector()
    shared, folder_before = cast("Any", HydraConfig.instance()), Path.cwd()
    before, shared.cfg = shared.cfg, config  # what is composed refers to it
    try:
        output = Path(
            str(OmegaConf.select(config, job_dir_key)), str(OmegaConf.select(config, job_subdir_key))
        )
        with read_write(config.hydra.runtime), open_dict(config.hydra.runtime):
            config.hydra.runtime.output_dir = os.path.abspath(output)
        OmegaConf.set_readonly(config.hydra, True)
        settings = _settings(config)
        output.mkdir(parents=True, exist_ok=True)
        _save(config, settings)
        if config.hydra.job.chdir:
            os.chdir(output)
        done = JobReturn(list(config.hydra.overrides.task), working_dir=os.getcwd())
        if configures_logging:
            configure_log(config.hydra.job_logging, config.hydra.verbose)
        with env_override(config.hydra.job.env_set):
            hydra_context.callbacks.on_job_start(config=config, task_function=task_function)
            try:
                if (training := getattr(task_function, "training", None)) is None:
                    done.return_value = task_function(settings)
                else:
                    done.return_value = yield from training(settings)
                done.status = JobStatus.COMPLETED
            except Exception as error:
                done.return_value, done.status = error, JobStatus.FAILED
        done.task_name = JobRuntime.instance().get("name")
        _flush_loggers()
        hydra_context.callbacks.on_job_end(config=config, job_return=done)
        return done
    finally:
        shared.cfg = before
        os.chdir(folder_before)


def _spare_the_collector() -> None:
    """Once, before the second job: a collection that walks through torch takes as long as pictures do."""
    if next(_jobs) == 1:
        gc.collect()
        gc.freeze()


def _settings(config: DictConfig) -> DictConfig:
    """A copy without Hydra's own part."""
    settings: DictConfig = pickle.loads(pickle.dumps(config))  # a third of the time of `copy.deepcopy`
    with read_write(settings), open_dict(settings):
        del settings["hydra"]
    return settings


def _save(config: DictConfig, settings: DictConfig) -> None:
    """Write the job's configuration to its folder."""
    if config.hydra.output_subdir is None:
        return
    folder = Path(config.hydra.runtime.output_dir, config.hydra.output_subdir)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(_yaml(_plain(settings)), encoding="utf-8")
    (folder / "hydra.yaml").write_text(_yaml({"hydra": _plain(config.hydra)}), encoding="utf-8")
    overrides = OmegaConf.to_yaml(config.hydra.overrides.task)
    (folder / "overrides.yaml").write_text(overrides, encoding="utf-8")


def _plain(config: DictConfig) -> dict[Any, Any]:
    return cast("dict[Any, Any]", OmegaConf.to_container(config, resolve=False, enum_to_str=True))


def _yaml(content: dict[Any, Any], above: tuple[Any, ...] = ()) -> str:
    """What `OmegaConf.to_yaml` returns for these entries of the section below the keys `above`."""
    parts = []
    for key, value in content.items():
        if isinstance(value, dict) and value:
            parts += [_entry(above, key, None).replace(" null\n", "\n"), _yaml(value, (*above, key))]
        else:
            parts.append(_entry(above, key, value))
    return "".join(parts)


def _entry(above: tuple[Any, ...], key: Any, value: Any) -> str:
    place = above, key, repr(value)
    if place not in _entries:
        if len(_entries) >= _MOST_ENTRIES:
            _entries.clear()
        content = {key: value}
        for each in reversed(above):
            content = {each: content}
        dumper = get_omega_conf_dumper()
        text = yaml.dump(
            content, default_flow_style=False, allow_unicode=True, sort_keys=False, Dumper=dumper
        )
        _entries[place] = "".join(text.splitlines(keepends=True)[len(above) :])
    return _entries[place]
