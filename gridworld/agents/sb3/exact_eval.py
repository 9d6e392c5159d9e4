"""Any model of SB3 scored exactly, whoever trained it: its policy over the states of a world, and a callback.

The greedy policy is what `predict` does on what the environment shows of each state, with the action masks of
that environment. What it explores with is read from its network.
"""

from __future__ import annotations

import inspect
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, is_vecenv_wrapped, sync_envs_normalization

from gridworld.agents.sb3.policy_outputs import (
    explored,
    is_of_libraries,
    predicted,
    read_table,
    why_unreadable,
    why_unsteady,
)
from gridworld.base.atomic_write import replacing, write_bytes
from gridworld.base.bounds import Bounds, Discount
from gridworld.base.console import tell
from gridworld.base.errors import InputError, on_a_line
from gridworld.config.compose import named_world
from gridworld.engine.sb3_format import model_file
from gridworld.envs.inspection import Task, alike, observation_like, task_of
from gridworld.envs.observations import KINDS, ObservationTable
from gridworld.run.folder import BEST_MODEL, EVALUATIONS
from gridworld.run.writer import write_evaluations
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import FloatArray, leaves_of
from gridworld.world.metrics import numbers
from gridworld.world.shown import channels_first

_STATISTICS = "vecnormalize.pkl"  # as RL Zoo calls it, for VecNormalize.load
_KINDS: dict[str, type] = {"step": np.int64, "certified": np.bool_}


class Tables(NamedTuple):
    """A model's policies, and what they follow from; (S, A), float64, each."""

    greedy: FloatArray  # action probabilities
    sampled: FloatArray | None  # the same; None: a custom `predict` decides, which shows no probabilities
    outputs: FloatArray  # action probabilities of an actor-critic, Q values of others


class ForeignPolicy:
    """A model's policy in a task.

    Args:
        model: an SB3 model, or its policy.
        task: the task, whose observations are asked for anew at every reading, since statistics may change.
    """

    def __init__(self, model: Any, task: Task) -> None:
        policy = model if isinstance(model, BasePolicy) else getattr(model, "policy", None)
        if not isinstance(policy, BasePolicy):
            raise InputError(f"{type(model).__name__}: is neither a model of Stable-Baselines3 nor a table")
        self._model, self._task, self._policy = model, task, policy
        self._guess_is_fine = False
        if policy.action_space != spaces.Discrete(task.mdp.num_actions):
            raise InputError(
                f"the model acts in {policy.action_space}; "
                f"{task.mdp.name} has Discrete({task.mdp.num_actions})"
            )
        if (reason := why_unreadable(policy)) is not None:
            raise InputError(f"the model {reason}")
        predicts = (model.predict, policy.predict)
        takes_masks = any("action_masks" in inspect.signature(each).parameters for each in predicts)
        self._masks = task.masks() if takes_masks else None
        self._is_known = is_of_libraries(model, policy)  # so that its network says how it explores
        self._check_statistics()
        if (reason := why_unsteady(model, policy, self._observation(), task.mdp, self._masks)) is not None:
            raise InputError(f"the model {reason}")

    def tables(self) -> Tables:
        """Ask it about every state. It is left as it was."""
        observation, was_training = self._observation(), self._policy.training
        _, probabilities, q = read_table(self._policy, observation, self._masks)
        outputs = q if probabilities is None else probabilities
        assert outputs is not None
        if not np.isfinite(outputs).all():
            raise InputError("the model's outputs are not finite numbers; its training has diverged")
        greedy = one_hot_policy(
            predicted(self._model, observation, self._task.mdp, self._masks), outputs.shape[1]
        )
        self._policy.set_training_mode(was_training)
        epsilon = float(getattr(self._model, "exploration_rate", 0.0))
        sampled = outputs if q is None else explored(greedy, epsilon)
        return Tables(greedy, sampled if self._is_known else None, outputs)

    def _observation(self) -> ObservationTable:
        """What it sees of each state: what the task shows, or the world's own observation with its space."""
        seen, wanted = None if self._task.seen is None else self._task.seen(), self._policy.observation_space
        if seen is not None and seen.space != wanted and seen.stored is not None:
            space, rows = channels_first(seen.space, seen.stored)
            seen = seen if space != wanted else ObservationTable(space, seen.num_states, rows)
        if seen is not None and seen.space == wanted:
            return seen
        if seen is not None and seen.kind not in KINDS:
            raise InputError(
                f"the model expects {on_a_line(wanted)}, but the environment shows "
                f"{on_a_line(seen.space)}; give the environment "
                "that it was trained on, model.get_env()"
            )
        guess = observation_like(self._task.mdp, wanted)
        self._check_guess(guess)
        return guess

    def _check_guess(self, guess: ObservationTable) -> None:
        """Refuse an observation that only has the right space, where the model was shown another one."""
        env = getattr(self._model, "get_env", lambda: None)()
        if env is None or self._guess_is_fine:
            return
        try:
            task = task_of(env)
            shown = None if task.seen is None else task.seen()
        except InputError as error:
            raise InputError(
                f"the model: its training observations are unknown ({error}); give an environment that "
                "shows the same ones"
            ) from None
        is_alike = shown is not None and alike(shown, guess)
        if not is_alike and (shown is None or shown.kind not in KINDS):
            raise InputError(
                f"the model was trained on custom observations, and {guess.kind} of this world merely has "
                "the same space; give an environment with the wrappers of training"
            )
        self._guess_is_fine = True

    def _check_statistics(self) -> None:
        """Refuse other statistics of VecNormalize than the model's; warn where a file has lost them."""
        own = getattr(self._model, "get_vec_normalize_env", lambda: None)()
        theirs, last = self._task.normalizer, getattr(self._model, "_last_obs", None)
        if own is not None and own.norm_obs:
            if theirs is None or not np.array_equal(_moments(own), _moments(theirs)):
                why = "does not apply" if theirs is None else "does not have"
                raise InputError(
                    f"the model was trained under VecNormalize, whose statistics the environment {why}; give "
                    "env=model.get_env(), or copy them with sync_envs_normalization(model.get_env(), env)"
                )
        elif last is not None and self._model.env is None:
            pairs = list(zip(leaves_of(self._observation().table()), leaves_of(last), strict=True))
            for at in range(len(pairs[0][1])):
                same = [(rows == each[at]).reshape(len(rows), -1).all(axis=1) for rows, each in pairs]
                if np.all(same, axis=0).any():
                    continue
                tell(
                    "the model: this world does not show what it saw last in training; if it was "
                    "trained under VecNormalize, give env=VecNormalize.load(FILE, batch)"
                )
                return


def _moments(normalizer: VecNormalize) -> FloatArray:
    """The means and variances by which it changes observations, (n,)."""
    found = normalizer.obs_rms
    parts = found.values() if isinstance(found, dict) else [found]
    return np.concatenate([each.ravel() for part in parts for each in (part.mean, part.var)])


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
                first of equals, and its `vecnormalize.pkl` if it learns under SB3's VecNormalize.
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
        Discount().check("gamma", gamma)
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
        task = task_of(named_world(env) if isinstance(env, str) else env, self._limit)
        self.evaluator = Evaluator(task.mdp, self._gamma, task.max_episode_steps)
        return task

    def _on_training_start(self) -> None:
        task = self._task or self._evaluate_on(self.training_env)
        self._copy_statistics()
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

    def _copy_statistics(self) -> None:
        """Evaluate with training's statistics of VecNormalize, as SB3's EvalCallback does."""
        if isinstance(self._env, VecEnv) and is_vecenv_wrapped(self._env, VecNormalize):
            sync_envs_normalization(self.training_env, self._env)

    def _evaluate(self) -> None:
        """Score the policy as it is now, and write what comes of it; once a step and policy."""
        assert self.evaluator is not None
        self._copy_statistics()
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
        by_sb3_names = {
            "mean_reward": score.outcome.expected_return,
            "mean_ep_length": score.outcome.expected_length,
            "success_rate": score.outcome.goal,
        }
        for name, number in (numbers(score) | by_sb3_names).items():
            self.logger.record(f"eval/{name}", float(number))
        self.logger.record("time/total_timesteps", step, exclude="tensorboard")
        self.logger.dump(step)
        if score.shortfall < self.best_regret:
            self.best_regret = score.shortfall
            if self.verbose >= 1:
                print(f"step {step:,}: new best model, exact regret {self.best_regret:.3g}")
            if self._best_path is not None:
                self._best_path.mkdir(parents=True, exist_ok=True)
                write_bytes(self._best_path / BEST_MODEL, model_file(self.model))
                if (normalizer := self.model.get_vec_normalize_env()) is not None:
                    with replacing(self._best_path / _STATISTICS) as part:
                        normalizer.save(str(part))
        if self._log_path is not None:
            table = self.evaluations
            self._log_path.mkdir(parents=True, exist_ok=True)
            write_evaluations(self._log_path / EVALUATIONS, table, **table)
