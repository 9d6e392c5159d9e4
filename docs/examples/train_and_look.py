"""Train an agent and look at what it learned: python docs/examples/train_and_look.py."""

import gridworld

run = gridworld.train("agent=dqn", "env=classic", seed=0)
print(run)

print("\n   step   regret  certified")
for step, regret, certified in list(
    zip(run.curve["step"], run.curve["regret"], run.curve["certified"], strict=True)
)[::3]:
    print(f"{step:7,}  {regret:7.3f}  {certified}")

print("\nwhat the greedy policy does, and what it thinks of each cell:")
layout = run.evaluator.mdp.layout
for row in range(layout.num_rows):
    states = [layout.state((row, col)) for col in range(layout.num_cols)]
    arrows = " ".join("^>v<"[run.policy.greedy[state]] for state in states)
    values = " ".join(f"{run.policy.values[state]:5.2f}" for state in states)
    print(f"  {arrows}    {values}")

# The model is an ordinary one of Stable-Baselines3.
one_hot = gridworld.OneHotObservation(gridworld.GridWorldEnv())
observation, _ = one_hot.reset(seed=0)
action, _ = run.model.predict(observation, deterministic=True)
print(f"\nfrom the start it goes {('up', 'right', 'down', 'left')[int(action)]}")
