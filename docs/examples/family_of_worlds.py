"""How often an agent's shipped settings end certified on worlds drawn at random.

    python docs/examples/family_of_worlds.py dqn --pairs 20

Draws worlds and seeds: maps of 4x4 to 12x12 cells, half of them `classic`, half with random walls and one to
three traps; slip 0, 0.05, 0.1 or 0.2; a step reward of 0, -0.01, -0.04 or -0.1; an observation. Each is
trained on once, with `agent=...` and nothing else. `--seed 2` draws the held-out ones of the documentation.
With `--samples 9.6e6` nothing is trained: the agent is replaced by the optimum of a world that is
estimated from so many transitions, as many of each state and action.
"""

import argparse
import dataclasses
import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import gridworld
from gridworld.base.errors import InputError
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.solver import value_iteration

PICTURES = ("policy_map", "q_error", "visits", "learning", "frames", "gif")
QUIET = [f"recording.{each}=false" for each in PICTURES]
QUIET += ["logging.tensorboard=false", "logging.progress=false", "checkpoint.every=null"]
Words = dict[str, str]


def draw(seed: int, count: int, maps: Path) -> Iterator[tuple[str, Words]]:
    """Yield the kind of map and the settings of each world, with the seed to train with."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        kind = "classic" if rng.random() < 0.5 else "random"
        words = classic(rng) if kind == "classic" else random_map(rng, maps / f"{number}.txt")
        words["env.slip"] = str(rng.choice([0.0, 0.05, 0.1, 0.2]))
        words["env.step_reward"] = str(rng.choice([0.0, -0.01, -0.04, -0.1]))
        words["observation"] = str(rng.choice(["one_hot", "coordinates", "image"]))
        words["seed"] = str(rng.integers(2**31))
        yield kind, words


def classic(rng: np.random.Generator) -> Words:
    """Of any size in which the goal can be reached."""
    while True:
        rows, cols = rng.integers(4, 13, 2)
        words = {"env.num_rows": str(rows), "env.num_cols": str(cols)}
        if is_world(words):
            return words


def random_map(rng: np.random.Generator, file: Path) -> Words:
    """Write a map in which the goal can be reached."""
    words = {"env.layout": str(file)}
    while True:
        cells = np.full(rng.integers(4, 13, 2), ".")
        cells[rng.random(cells.shape) < rng.uniform(0, 0.3)] = "#"
        signs = "SG" + "T" * int(rng.integers(1, 4))
        cells.flat[rng.permutation(cells.size)[: len(signs)]] = list(signs)
        file.write_text("\n".join(map("".join, cells)) + "\n")
        if is_world(words):
            return words


def is_world(words: Words) -> bool:
    try:
        gridworld.compose("agent=value_iteration", words).env.compile()
    except InputError:
        return False
    return True


def trained(agent: str, words: Words, overrides: list[str]) -> dict[str, object]:
    """How a run with the agent's settings ends."""
    run = gridworld.train(f"agent={agent}", *QUIET, words, *overrides)
    scale = float(run.evaluator.mdp.start @ run.evaluator.solution.scale)
    return {
        "certified": bool(run.summary["certified"]),
        "ever": bool(run.curve["certified"].any()),
        "relative regret": run.summary["regret"] / max(scale, 1e-12),
    }


def planned(agent: str, words: Words, samples: float) -> dict[str, object]:
    """How planning ends, with the agent's discount, in a world estimated from this many transitions."""
    config = gridworld.compose(f"agent={agent}", words)
    mdp, rng = config.env.compile(), np.random.default_rng(int(words["seed"]))
    each = max(1, round(samples / mdp.probability[..., 0].size))
    estimate = rng.multinomial(each, mdp.probability) / each
    found = value_iteration(dataclasses.replace(mdp, probability=estimate), config.agent.gamma)
    judge = Evaluator(mdp, config.evaluation.gamma, 1)
    score = judge.score(one_hot_policy(np.argmax(found.q, axis=1), mdp.num_actions))
    scale = float(mdp.start @ judge.solution.scale)
    return {
        "certified": score.certified,
        "ever": score.certified,
        "relative regret": score.regret / max(scale, 1e-12),
    }


def table(results: list[Words]) -> Iterator[str]:
    """Yield a line for each value of what the worlds differ in."""
    for key in ("kind", "env.slip", "env.step_reward", "observation", "cells"):
        for value in sorted({result[key] for result in results}):
            yield line(f"{key} {value}", [result for result in results if result[key] == value])
    yield line("all", results)


def line(name: str, results: list[Words]) -> str:
    at_end, ever = (sum(result[key] == "True" for result in results) for key in ("certified", "ever"))
    close = sum(float(result["relative regret"]) < 0.01 for result in results)
    return f"| {name} | {len(results)} | {at_end} | {ever} | {close} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("agent", nargs="?", default="dqn")
    parser.add_argument("overrides", nargs="*", default=[], help="further settings of every run")
    parser.add_argument("--pairs", type=int, default=4, help="of a world and a seed")
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("--samples", type=float, help="plan on so many transitions, in place of training")
    parser.add_argument("--observations", nargs="+", default=["one_hot", "coordinates", "image"])
    options = parser.parse_args()
    if options.samples is not None and options.samples < 1:
        parser.error(f"--samples {options.samples:g}: must be at least 1")
    results = []
    with tempfile.TemporaryDirectory() as maps:
        for number, (kind, words) in enumerate(draw(options.seed, options.pairs, Path(maps))):
            if words["observation"] not in options.observations:
                continue
            began = time.process_time()
            if options.samples is None:
                found = trained(options.agent, words, options.overrides)
            else:
                found = planned(options.agent, words, options.samples)
            config = gridworld.compose(f"agent={options.agent}", words)
            states = config.env.compile().num_states
            cells = "up to 64" if states <= 64 else "more than 64"
            results.append(
                {**words, "number": str(number), "kind": kind, "cells": cells, "states": str(states)}
                | {"gamma": str(config.agent.gamma), "certified": str(found["certified"])}
                | {"ever": str(found["ever"]), "relative regret": f"{found['relative regret']:.2g}"}
                | {"seconds": f"{time.process_time() - began:.1f}"}
            )
            print(json.dumps(results[-1]), flush=True)
    print("\n| | runs | certified | at some time | regret below 1 % |\n|---|--:|--:|--:|--:|")
    print("\n".join(table(results)))


if __name__ == "__main__":
    main()
