"""Q-learning in pure NumPy, checked: python docs/examples/check_a_numpy_agent.py."""

import numpy as np

import gridworld


def train(env, total_timesteps, seed, gamma):
    """An ordinary agent for an ordinary environment of Gymnasium; it knows nothing of gridworld."""
    rng = np.random.default_rng(seed)
    q = np.zeros((env.observation_space.n, env.action_space.n))
    visits = np.zeros_like(q)
    state, _ = env.reset(seed=seed)
    for step in range(total_timesteps):
        if rng.random() < max(0.1, 1 - 2 * step / total_timesteps):
            action = rng.integers(env.action_space.n)
        else:
            action = q[state].argmax()
        following, reward, terminated, truncated, _ = env.step(action)
        target = reward if terminated else reward + gamma * q[following].max()
        visits[state, action] += 1
        rate = 10 / (10 + visits[state, action])
        q[state, action] += rate * (target - q[state, action])
        state = following
        if terminated or truncated:
            state, _ = env.reset()
    return {"q": q}


def test_my_agent(gridworld_check):
    """With pytest: python -m pytest docs/examples/check_a_numpy_agent.py."""
    gridworld_check(train)


if __name__ == "__main__":
    print(gridworld.check(train))
