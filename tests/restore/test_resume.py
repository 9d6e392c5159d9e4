"""A run that was stopped anywhere goes on and ends as if nothing had happened, to the last bit."""

from pathlib import Path

import pytest
from helpers.resuming import Crash, begin, crash_after, differences, go_on, left_behind, stopped_after
from helpers.support import SHORT

CASES = {
    "dqn": [*SHORT["dqn"], "agent.learning_rate=lin_0.003"],
    **{
        f"dqn that counts{stock}": [
            *(*SHORT["dqn"], "agent.replay_buffer_class=gridworld.agents.sb3.replay_counts.ReplayCounts"),
            *("agent.engine=stock", "agent.gradient_steps=4")[: 2 * bool(stock)],
        ]
        for stock in ("", " stock")
    },
    "dqn stock": [
        *(*SHORT["dqn"], "agent.engine=stock", "n_envs=8"),
        *("agent.buffer_size=2000", "agent.gradient_steps=4"),
    ],
    "dqn stock that stores an observation once": [
        *(*SHORT["dqn"], "agent.engine=stock", "n_envs=8", "agent.optimize_memory_usage=true"),
        *("+agent.replay_buffer_kwargs.handle_timeout_termination=false", "agent.gradient_steps=4"),
    ],
    "ppo": [
        *SHORT["ppo"],
        "agent.ent_coef=quad_0.5",
        "agent.gae_lambda=lin_0.5",
        "agent.learning_rate=sqrt_0.01",
        "stratified_draws=true",
        "env.slip=0.1",
    ],
    "ppo stock": [*SHORT["ppo"], "agent.engine=stock", "agent.log_interval=2", "n_envs=8"],
    **{f"{name} stock": [*SHORT[name], "agent.engine=stock"] for name in ("a2c", "qrdqn", "trpo")},
    **{name: SHORT[name] for name in ("a2c", "qrdqn", "trpo", "q_learning", "sarsa", "expected_sarsa")},
}
LESS = ["recording.frames=false", "recording.gif=false", "env.slip=0.1", "exploration_bonus=0.1"]


@pytest.mark.parametrize("case", CASES)
def test_every_agent_goes_on_to_the_bit(case: str, tmp_path: Path) -> None:
    """After its process has died at the first checkpoint, and again some later."""
    words = [*CASES[case], *LESS]
    begin(tmp_path / "calm", *words)
    stopped_after(1, tmp_path / "run", *words, "checkpoint.every=150")
    with pytest.MonkeyPatch.context() as patched:
        crash_after(patched, 2)
        with pytest.raises(Crash):
            go_on(tmp_path / "run")
    go_on(tmp_path / "run")
    assert differences(left_behind(tmp_path / "run"), left_behind(tmp_path / "calm")) == []
