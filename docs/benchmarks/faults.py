"""Faults from published catalogues: which `check` finds, `diagnose` names, and a test on rewards would find.

    python docs/benchmarks/faults.py --results runs/faults.jsonl --seeds 5 --jobs 2

trains every fault of `CATALOGUE` on three worlds and five seeds, prints the tables of
`docs/reference/faults.md`, and writes `docs/data/faults.csv`, a row for each fault. What the file of results
already has is not trained again.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import multiprocessing
import re
import statistics
import sys
import tempfile
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import gridworld

WORLDS = {
    "classic": None,
    "detour": ".S.#..\n...T..\n.##...\n..T.#.\n....G.\n",
    "rooms": "..#...\nS.T...\n..#.#.\n......\n.T..G.\n",
}
FIRST_SEED = 500
_DQN = {
    "learning_rate": 0.001, "buffer_size": 50000, "batch_size": 128, "gamma": 0.9, "gradient_steps": 32,
    "target_update_interval": 512, "exploration_fraction": 1.0, "exploration_final_eps": 0.05,
}  # fmt: skip
_PPO = {
    "n_steps": 32, "batch_size": 2048, "n_epochs": 5, "learning_rate": 0.01, "ent_coef": 0.5, "gamma": 0.95,
}  # fmt: skip
_STEPS = {"dqn": 30_000, "ppo": 90_000, "a2c": None}  # None: as shipped
_OWN = {"dqn": _DQN, "ppo": _PPO}
_SHIPPED_A2C = ("learning_rate", "n_steps", "gamma", "ent_coef")  # the arguments that its yaml has


@dataclass(frozen=True)
class Fault:
    """A fault, as one of our runs.

    Attributes:
        source: who described it.
        operator: its name there.
        agent: `dqn`, `ppo` or `a2c`, whose settings it begins with.
        change: the name of a class in `faulty`, or words for the command line.
        causes: of `diagnose`, those that name it.
    """

    source: str
    operator: str
    agent: str
    change: str
    causes: tuple[str, ...]

    @property
    def is_class(self) -> bool:
        return "=" not in self.change

    @property
    def name(self) -> str:
        return (
            f"{self.operator} {self.agent}"
            if self.is_class
            else f"{self.operator} {self.agent}: {self.change}"
        )

    @property
    def title(self) -> str:
        """Its row's title: where it is from, its operator, and what was changed."""
        change = re.sub(r"agent\.(policy_kwargs\.)?|torch\.(nn|optim)\.", "", self.change)
        return f"{self.source}: {self.operator} | {self.agent if self.is_class else f'{self.agent} {change}'}"

    @property
    def words(self) -> list[str]:
        steps = _STEPS[self.agent]
        length = [] if steps is None else [f"total_timesteps={steps}", f"evaluation.every={steps // 10}"]
        if self.is_class:
            own = _OWN.get(self.agent, {})
            dropped = [f"~agent.arguments.{key}" for key in _SHIPPED_A2C if own and key not in own]
            given = [f"{'' if key in _SHIPPED_A2C else '+'}agent.arguments.{key}={own[key]}" for key in own]
            chosen = [f"agent.algorithm=faulty.{self.change}", "agent.log_interval=100"]
            envs = ["n_envs=128"] if own else []
            return ["agent=a2c", "agent.name=own", *chosen, *envs, *length, *dropped, *given]
        own = [f"agent.{key}={value}" for key, value in _OWN.get(self.agent, {}).items()]
        changes = self.change.split()
        keys = {word.split("=")[0] for word in changes}
        sound = [word for word in ["n_envs=128", *length, *own] if word.split("=")[0] not in keys]
        return [f"agent={self.agent}", *(sound if self.agent != "a2c" else []), *changes]


def _everywhere(source: str, operator: str, suffix: str, agents: str, causes: str) -> list[Fault]:
    return [
        Fault(source, operator, each, each.upper() + suffix, tuple(causes.split())) for each in agents.split()
    ]


def _set(source: str, operator: str, agent: str, causes: str, *changes: str) -> list[Fault]:
    return [Fault(source, operator, agent, change, tuple(causes.split())) for change in changes]


_M, _P, _L = "RLMutation", "muPRL", "DRLinter"
CATALOGUE = (
    *_everywhere(_M, "RN, reward noise", "RewardNoise", "dqn ppo a2c", "implementation"),
    *_everywhere(_M, "M, mangled", "Mangled", "dqn ppo a2c", "implementation"),
    *_everywhere(_M, "Ra, random", "Random", "dqn ppo a2c", "implementation"),
    *_everywhere(_M, "R, repeat", "Repeat", "dqn ppo a2c", "implementation"),
    *_everywhere(_M, "NDF, no discount", "NoDiscount", "dqn ppo a2c", "implementation"),
    *_everywhere(_M, "MTS, missing terminal state", "MissingTerminal", "dqn ppo a2c", "implementation"),
    *_everywhere(_M, "NR, no reverse", "NoReverse", "ppo a2c", "implementation"),
    *_everywhere(_M, "MSU, missing state update", "MissingStateUpdate", "dqn ppo a2c", "implementation"),
    *_everywhere(_M, "ILF, incorrect loss", "IncorrectLoss", "dqn ppo a2c", "implementation"),
    *_set(_M, "PAC, activation", "dqn", "network slow",
          "agent.policy_kwargs.activation_fn=torch.nn.Sigmoid"),
    *_set(_M, "PAC, activation", "ppo", "network slow rate",
          "agent.policy_kwargs.activation_fn=torch.nn.Sigmoid",
          "agent.policy_kwargs.activation_fn=torch.nn.ReLU"),
    *_set(_M, "POC, optimiser", "dqn", "slow network", "agent.policy_kwargs.optimizer_class=torch.optim.SGD"),
    *_set(_M, "POC, optimiser", "ppo", "slow network",
          "agent.policy_kwargs.optimizer_class=torch.optim.SGD agent.policy_kwargs.optimizer_kwargs={}"),
    *_set(_P, "ent_coef", "ppo", "exploration entropy", "agent.ent_coef=0.01", "agent.ent_coef=0.2"),
    *_set(_P, "exploration_final_eps", "dqn", "exploration", "agent.exploration_final_eps=0.5",
          "agent.exploration_final_eps=1.0"),
    *_set(_P, "gamma", "dqn", "objective", "agent.gamma=0.45", "agent.gamma=0.9999"),
    *_set(_P, "gamma", "ppo", "objective", "agent.gamma=0.45", "agent.gamma=0.9999"),
    *_set(_P, "learning_starts", "dqn", "slow budget", "agent.learning_starts=7500",
          "agent.learning_starts=15000"),
    *_set(_P, "n_steps", "ppo", "slow rate budget", "agent.n_steps=16", "agent.n_steps=256"),
    *_set(_P, "n_timesteps", "dqn", "budget slow", "total_timesteps=3000 evaluation.every=300",
          "total_timesteps=15000 evaluation.every=1500"),
    *_set(_P, "n_timesteps", "ppo", "budget slow", "total_timesteps=9000 evaluation.every=900",
          "total_timesteps=45000 evaluation.every=4500"),
    *_set(_P, "target_update_interval", "dqn", "target slow", "agent.target_update_interval=3000",
          "agent.target_update_interval=9000"),
    *_set(_P, "tau", "dqn", "target slow", "agent.tau=0.0005", "agent.tau=0.12"),
    *_set(_L, "missing exploration", "dqn", "exploration",
          "agent.exploration_initial_eps=0 agent.exploration_final_eps=0"),
    *_everywhere(_L, "missing reset", "NotReset", "dqn", "implementation"),
    *_everywhere(_L, "missing step", "NotStepped", "dqn", "implementation"),
    *_everywhere(_L, "missing terminal state", "MissingTerminal", "dqn", "implementation"),
    *_set(_L, "exploration never falls", "dqn", "exploration",
          "agent.exploration_initial_eps=0.99 agent.exploration_final_eps=0.99"),
    *_everywhere(_L, "exploration rises", "EpsilonRises", "dqn", "implementation"),
    *_set(_L, "target updated too often", "dqn", "rate diverged slow", "agent.target_update_interval=2"),
    *_everywhere(_L, "output ReLU", "OutputReLU", "dqn", "implementation"),
    *_everywhere(_L, "output softmax", "OutputSoftmax", "dqn", "implementation"),
    *_everywhere(_L, "target copied to the learner", "TargetTaught", "dqn", "implementation"),
    *_everywhere(_L, "target never updated", "TargetKept", "dqn", "implementation"),
    *_everywhere(_L, "value as action", "MaximumAsAction", "dqn", "implementation"),
    *_everywhere(_L, "wrong update rule", "WrongUpdateRule", "dqn", "implementation"),
    *_everywhere(_L, "Stack Overflow 47643678", "OneNetworkEndless", "dqn", "implementation"),
    *_set(_L, "Stack Overflow 47750291", "dqn", "exploration slow",
          "agent.exploration_initial_eps=0 agent.exploration_final_eps=0 agent.gradient_steps=1 "
          "agent.batch_size=32 agent.gamma=0.95"),
    *_set(_L, "Stack Overflow 49035549", "dqn", "exploration",
          "agent.exploration_fraction=0.003 agent.batch_size=15"),
    *_set(_L, "Stack Overflow 50308750", "dqn", "slow budget", "agent.learning_starts=30000"),
    *_set(_L, "Stack Overflow 51425688", "dqn", "objective exploration",
          "agent.gamma=0.3 agent.exploration_initial_eps=0.05 agent.exploration_final_eps=0.05"),
    *_everywhere(_L, "Stack Overflow 54385568", "WithoutAction", "dqn", "implementation"),
)  # fmt: skip
NOT_EXPRESSED = {
    "missing close": "an environment that is not closed gives the same numbers",
    "missing initialisation": "a program without an environment stops with a NameError",
}
SOUND = tuple(Fault("sound", "sound", each, f"{each.upper()}Sound", ()) for each in ("dqn", "ppo", "a2c"))

SHIPPED = tuple(
    Fault("sound", f"shipped {each}", each, f"agent={each}", ())
    for each in ("q_learning", "sarsa", "expected_sarsa", "dqn", "qrdqn", "ppo", "a2c", "trpo")
)
SHIPPED_WORLDS = ("classic", "aima_4x3", "cliff", "frozen_lake_4x4", "four_rooms", "taxi_v4")


def half(fault: Fault) -> str:
    """Which half of the operators a fault is in: by their order, whatever their results."""
    operators = list(dict.fromkeys((each.source, each.operator) for each in CATALOGUE))
    return "AB"[operators.index((fault.source, fault.operator)) % 2]


# ---- runs --------------------------------------------------------------------------------------------------


def trained(fault: Fault, world: str, seed: int) -> dict[str, Any]:
    """One run: whether it is certified, its return, and the first cause that `diagnose` names."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        place = ["env=classic"]
        if (text := WORLDS[world]) is not None:
            file = Path(folder) / f"{world}.txt"
            file.write_text(text)
            place.append(f"env.layout={file}")
        row: dict[str, Any] = {"fault": fault.name, "world": world, "seed": seed}
        try:
            run = gridworld.train(*fault.words, *place, seed=seed, progress=False)
            row |= {"certified": run.summary["certified"], "return": run.summary["return"]}
            row["cause"] = None if row["certified"] else gridworld.diagnose(run).cause
        except Exception as error:  # of the fault's: a run that stops with an error shows it
            row |= {"certified": False, "return": None, "cause": "error", "error": str(error)}
    return row | {"seconds": round(time.monotonic() - started, 1)}


def checked(fault: Fault, world: str, seed: int) -> dict[str, Any]:
    """The probes that a class fails."""
    found = gridworld.check(f"faulty.{fault.change}", seed=seed)
    return {
        "fault": fault.name,
        "world": "check",
        "seed": seed,
        "failed": found.failed,
        "seconds": found.seconds,
    }


def sound(fault: Fault, world: str, seed: int) -> dict[str, Any]:
    """One run of a shipped agent at its shipped settings in a shipped world, which has no fault."""
    started = time.monotonic()
    run = gridworld.train(*fault.change.split(), f"env={world}", seed=seed, progress=False)
    cause = None if run.summary["certified"] else gridworld.diagnose(run).cause
    row = {"fault": fault.name, "world": world, "seed": seed, "certified": run.summary["certified"]}
    return row | {"cause": cause, "seconds": round(time.monotonic() - started, 1)}


Job = tuple[Callable[[Fault, str, int], dict[str, Any]], Fault, str, int]


def jobs(seeds: int, sound_seeds: int) -> Iterator[Job]:
    """What there is to run, seed by seed, so that it may be stopped at any time."""
    for number in range(max(seeds, sound_seeds)):
        seed = FIRST_SEED + number
        if number < seeds:
            for fault, world in itertools.product((*SOUND, *CATALOGUE), WORLDS):
                yield trained, fault, world, seed
        if number == 0:
            for fault in {each.change: each for each in (*SOUND, *CATALOGUE) if each.is_class}.values():
                yield checked, fault, "check", seed
        if number < sound_seeds:
            for fault, world in itertools.product(SHIPPED, SHIPPED_WORLDS):
                yield sound, fault, world, seed


def _run(job: Job) -> dict[str, Any]:
    warnings.simplefilter("ignore")
    function, *given = job
    return function(*given)


# ---- tables ------------------------------------------------------------------------------------------------

Rows = list[dict[str, Any]]


def killed_by_rewards(spoilt: Rows, unspoilt: Rows) -> bool:
    """Whether Welch's test finds the returns of the two different in some world (p < 0.05, by Bonferroni)."""
    for world in WORLDS:
        ours, theirs = (
            [row["return"] for row in rows if row["world"] == world and row["return"] is not None]
            for rows in (spoilt, unspoilt)
        )
        if len(ours) < 2 or len(theirs) < 2:
            if any(row["cause"] == "error" for row in spoilt if row["world"] == world):
                return True
            continue
        if np.ptp(ours) == np.ptp(theirs) == 0:
            if ours[0] != theirs[0]:
                return True
        elif stats.ttest_ind(ours, theirs, equal_var=False).pvalue < 0.05 / len(WORLDS):
            return True
    return False


def named(rows: Rows, fault: Fault) -> tuple[int, dict[str, int]]:
    """Of a fault's runs that are not certified: how many have the right first cause, and the other causes."""
    causes = Counter(str(row["cause"]) for row in rows if not row["certified"])
    right = sum(causes.pop(cause, 0) for cause in (*fault.causes, "error"))
    return right, dict(causes.most_common())


def table(rows: Rows, every: Path) -> Iterator[str]:
    """The page's tables, as Markdown; what the totals are made of goes to the CSV `every`."""
    of, probes = defaultdict(list), {}
    for row in rows:
        if row["world"] == "check":
            probes[row["fault"]] = row["failed"]
        else:
            of[row["fault"]].append(row)
    by_class = {each.change: probes[each.name] for each in (*SOUND, *CATALOGUE) if each.name in probes}
    totals: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    confusions: Counter[tuple[str, str]] = Counter()
    columns = ("fault", "agent", "half", "spoilt", "of", "right", "named instead", "check", "rewards")
    lines: list[tuple[object, ...]] = [columns]
    for fault in CATALOGUE:
        mine = of[fault.name]
        right, instead = named(mine, fault)
        confusions.update({(fault.causes[0], cause): count for cause, count in instead.items()})
        spoilt = sum(not row["certified"] for row in mine)
        failed = by_class.get(fault.change)
        is_killed = killed_by_rewards(mine, of[f"sound {fault.agent}"])
        probes_failed = "" if failed is None else len(failed) or "passes"
        counts = (half(fault), spoilt, len(mine), right, _listed(instead).replace("`", ""), probes_failed)
        lines.append((*fault.title.split(" | "), *counts, "killed" if is_killed else ""))
        for key in ((fault.source, half(fault)), ("all", half(fault)), ("all", "both")):
            totals[key].update(
                faults=1, runs=len(mine), spoilt=spoilt, right=right, classes=failed is not None,
                check=bool(failed), rewards=is_killed, some=bool(spoilt),
            )  # fmt: skip
    yield "| | half | faults | spoil a run | runs | spoilt | first cause right | `check` kills | rewards |"
    yield "|---|---|--:|--:|--:|--:|--:|--:|--:|"
    for source, part in sorted(totals, key=lambda key: (key[0] == "all", key)):
        n = totals[source, part]
        share = f"{n['right']} ({n['right'] / max(n['spoilt'], 1):.0%})"
        yield (
            f"| {source} | {part} | {n['faults']} | {n['some']} | {n['runs']} | {n['spoilt']} | {share} | "
            f"{n['check']} of {n['classes']} | {n['rewards']} of {n['faults']} |"
        )
    with every.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)
    yield "\n| what was wrong | named instead | runs |\n|---|---|--:|"
    for (cause, other), count in confusions.most_common():
        yield f"| `{cause}` | `{other}` | {count} |"
    yield "\n| without a fault | runs | certified | first cause of the others | `implementation` named |"
    yield "|---|--:|--:|---|--:|"
    for fault in (*SOUND, *SHIPPED):
        _, causes = named(of[fault.name], fault)
        certified = sum(row["certified"] for row in of[fault.name])
        what = f"`{fault.change}`" if fault in SHIPPED else f"a class derived from {fault.agent.upper()}"
        yield (
            f"| {what} | {len(of[fault.name])} | {certified} | {_listed(causes)} | "
            f"{causes.get('implementation', 0)} |"
        )
    took = [row["seconds"] for row in rows] or [0]
    yield f"\n{len(rows)} trainings and checks, {statistics.median(took):.1f} s each at the median."


def _listed(causes: dict[str, int]) -> str:
    return ", ".join(f"`{cause}` {count}" for cause, count in causes.items())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--results", type=Path, required=True, help="a file of results, one JSON object a line"
    )
    parser.add_argument("--seeds", type=int, default=5, help="of each fault in each world")
    parser.add_argument(
        "--sound-seeds", type=int, default=20, help="of each shipped agent in each shipped world"
    )
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time; 0: print the tables only")
    every = Path(__file__).parents[1] / "data" / "faults.csv"
    parser.add_argument("--csv", type=Path, default=every, help="where every fault is written")
    words = parser.parse_args()
    words.results.touch()
    rows = [json.loads(line) for line in words.results.read_text().splitlines()]
    have = {(row["fault"], row["world"], row["seed"]) for row in rows}
    if words.jobs:
        missing = [
            job for job in jobs(words.seeds, words.sound_seeds) if (job[1].name, job[2], job[3]) not in have
        ]
        context = multiprocessing.get_context("fork")
        with context.Pool(words.jobs, maxtasksperchild=20) as pool, words.results.open("a") as file:
            for number, row in enumerate(pool.imap_unordered(_run, missing), 1):
                rows.append(row)
                file.write(json.dumps(row) + "\n")
                file.flush()
                print(f"{number}/{len(missing)} {row}", file=sys.stderr)
    print(*table(rows, words.csv), sep="\n")


if __name__ == "__main__":
    main()
