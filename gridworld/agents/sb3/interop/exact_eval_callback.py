"""SB3's `EvalCallback` without episodes: the greedy policy's exact scores while any SB3 model learns."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, is_vecenv_wrapped, sync_envs_normalization

from gridworld.agents.sb3.interop.foreign_model import ForeignPolicy
from gridworld.bounds import Bounds, discount
from gridworld.envs.inspection import Task, task_of
from gridworld.run.evaluations_file import write_evaluations
from gridworld.run.folder import BEST_MODEL, EVALUATIONS
from gridworld.storage.atomic_write import replacing
from gridworld.world.exact.evaluation import Evaluator, Score
from gridworld.world.metrics import numbers

_KINDS: dict[str, type] = {"step": np.int64, "certified": np.bool_}


class ExactEvalCallback(BaseCallback):
    """Evaluates the greedy policy exactly before, during and after training.

    Goes to SB3's own logger, and so to its TensorBoard, CSV or standard output: `eval/regret`, `eval/value`,
    `eval/certified`, `eval/goal_probability`, ..., and by SB3's names `eval/mean_reward`,
    `eval/mean_ep_length` and `eval/success_rate`. Nothing is sampled: no random number is drawn, no
    environment is stepped, and training goes on as without the callback.

    Attributes:
        evaluator: scores policies of the world; None before training begins.
        best_regret: the lowest regret so far.
        stopped_at: the step at which `stop_after` ended training; None: it did not.

    Example:
        >>> from stable_baselines3 import DQN
        >>> import gridworld, gymnasium as gym
        >>> callback = gridworld.ExactEvalCallback(every=500)
        >>> model = DQN("MlpPolicy", gym.make("GridWorld-v0")).learn(50_000, callback=callback)
        >>> callback.evaluations["regret"][-1]
    """

    def __init__(
        self,
        env: Any = None,
        every: int = 1000,
        best_model_save_path: str | PathLike[str] | None = None,
        log_path: str | PathLike[str] | None = None,
        stop_after: int | None = None,
        gamma: float = 0.99,
        max_episode_steps: int | None = None,
        verbose: int = 0,
    ) -> None:
        """Set up; nothing is read or written before training begins.

        Args:
            env: what to evaluate on, as for `gridworld.evaluate`; None: what the model is trained on.
            every: environment steps between two evaluations.
            best_model_save_path: a folder for `best_model.zip`, the model of the lowest exact regret, the
                first of equals.
            log_path: a folder for `evaluations.npz`: `timesteps`, `results`, `ep_lengths` and `successes` as
                SB3's `EvalCallback` writes them, and the columns of `evaluations`.
            stop_after: end training at so many certificates of optimality in a row, each of another policy;
                None: never.
            gamma: discount of value and regret.
            max_episode_steps: step limit of an episode; None: the environment's own.
            verbose: 1 prints a line at every new best model.

        Raises:
            InputError: an argument out of its bounds, or an environment that is no GridWorld.
        """
        super().__init__(verbose)
        Bounds(1).check("every", every)
        discount("gamma", gamma)
        if stop_after is not None:
            Bounds(1).check("stop_after", stop_after)
        self.evaluator: Evaluator | None = None
        self.best_regret = np.inf
        self.stopped_at: int | None = None
        self._every, self._gamma, self._limit = every, gamma, max_episode_steps
        self._best_path = None if best_model_save_path is None else Path(best_model_save_path)
        self._log_path = None if log_path is None else Path(log_path)
        self._stop_after = stop_after
        self._rows: list[dict[str, float]] = []
        self._streak = 0  # certificates in a row
        self._newest: NDArray[Any] | None = None  # the outputs that were evaluated last
        self._next = 0
        self._env, self._task = env, None if env is None else self._evaluate_on(env)

    @property
    def evaluations(self) -> dict[str, NDArray[Any]]:
        """{name: (evaluations,)}: `step`, and every metric of `RunResult.curve` of the greedy policy."""
        names = self._rows[0] if self._rows else {}
        table = {name: np.array([row[name] for row in self._rows]) for name in names}
        return table | {name: table[name].astype(kind) for name, kind in _KINDS.items() if name in table}

    def _evaluate_on(self, env: Any) -> Task:
        task = task_of(env, self._limit)
        self.evaluator = Evaluator(task.mdp, self._gamma, task.max_episode_steps)
        return task

    def _on_training_start(self) -> None:
        task = self._task or self._evaluate_on(self.training_env)
        self._policy = ForeignPolicy(self.model, task)  # refuses what has no table
        self._evaluate()

    def _on_step(self) -> bool:
        # The last step is left to the end of training, since an update may still follow it.
        if self._next <= self.num_timesteps < self.model._total_timesteps:
            self._evaluate()
        if self._stop_after is not None and self._streak >= self._stop_after:
            self.stopped_at = self.num_timesteps
            return False
        return True

    def _on_training_end(self) -> None:
        self._evaluate()

    def _evaluate(self) -> None:
        """Score the policy as it is now, and write what comes of it; once a step and policy."""
        assert self.evaluator is not None
        if isinstance(self._env, VecEnv) and is_vecenv_wrapped(self._env, VecNormalize):
            sync_envs_normalization(self.training_env, self._env)  # as SB3's EvalCallback does
        step = self.num_timesteps
        self._next = (step // self._every + 1) * self._every
        tables = self._policy.tables()
        is_new = self._newest is None or not np.array_equal(self._newest, tables.outputs)
        if not is_new and self._rows[-1]["step"] == step:
            return
        self._newest = tables.outputs
        score = self.evaluator.score(tables.greedy)
        self._rows.append({"step": step, **numbers(score)})
        self._streak = self._streak + is_new if score.certified else 0
        self._log(score)
        if score.shortfall < self.best_regret:
            self._keep_best(score.shortfall)
        if self._log_path is not None:
            self._write(self._log_path)

    def _log(self, score: Score) -> None:
        outcome = score.outcome
        by_sb3_names = {
            "mean_reward": outcome.expected_return,
            "mean_ep_length": outcome.expected_length,
            "success_rate": outcome.goal,
        }
        for name, number in (numbers(score) | by_sb3_names).items():
            self.logger.record(f"eval/{name}", float(number))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def _keep_best(self, regret: float) -> None:
        self.best_regret = regret
        if self.verbose >= 1:
            print(f"step {self.num_timesteps:,}: new best model, exact regret {self.best_regret:.3g}")
        if self._best_path is not None:
            self._best_path.mkdir(parents=True, exist_ok=True)
            with replacing(self._best_path / BEST_MODEL) as part, part.open("wb") as file:
                self.model.save(file)

    def _write(self, folder: Path) -> None:
        table = self.evaluations
        folder.mkdir(parents=True, exist_ok=True)
        write_evaluations(folder / EVALUATIONS, table, **table)
