"""Exact scores for plain SB3 code, and the best model by exact regret.

python docs/examples/exact_callback_with_plain_sb3.py
"""

import tempfile

from stable_baselines3 import PPO

import gridworld

envs = gridworld.make_vec_env("aima_4x3", n_envs=16)
model = PPO("MlpPolicy", envs, n_steps=64, batch_size=256, learning_rate=0.003, gamma=0.95, seed=0)

with tempfile.TemporaryDirectory() as folder:
    callback = gridworld.ExactEvalCallback(every=1024, best_model_save_path=folder, stop_after=2)
    model.learn(60_000, callback=callback)
    best = PPO.load(f"{folder}/best_model.zip", env=envs)

for step, regret, goal in zip(
    *(callback.evaluations[name] for name in ("step", "regret", "goal_probability")), strict=True
):
    print(f"{step:7,} steps: exact regret {abs(regret):.3f}, reaches the goal with probability {goal:.2f}")

score = gridworld.evaluate(best)
print(f"the best model: regret {abs(score.regret):.3f}, certified optimal: {score.certified}")
