"""Turn a section of an RL Zoo yaml into an agent: from_rl_zoo.py dqn.yml CartPole-v1 mine/agent/zoo.yaml

The file's name says the algorithm, as in RL Zoo's folder `hyperparams`. Then: --config-dir mine agent=zoo
"""

import ast
import sys
from pathlib import Path
from typing import Any

import yaml

CLASSES = {
    "a2c": "stable_baselines3.A2C",
    "dqn": "stable_baselines3.DQN",
    "ppo": "stable_baselines3.PPO",
    "qrdqn": "sb3_contrib.QRDQN",
    "trpo": "sb3_contrib.TRPO",
}
OF_THE_RUN = {"n_timesteps": "total_timesteps", "n_envs": "n_envs"}
# RL Zoo's own: wrappers, callbacks, what it makes of the environment and its observations.
LEFT_OUT = (
    "env_wrapper",
    "vec_env_wrapper",
    "callback",
    "env_kwargs",
    "monitor_kwargs",
    "frame_stack",
    "normalize",
)
LIBRARIES = {"nn": "torch.nn", "th": "torch", "torch": "torch", "optim": "torch.optim"}


def plain(node: ast.expr) -> Any:
    """The value of `dict(net_arch=[64, 64], activation_fn=nn.ReLU)`, say, without running it."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dict":
        return {str(keyword.arg): plain(keyword.value) for keyword in node.keywords}
    if isinstance(node, ast.Attribute):
        first, *rest = ast.unparse(node).split(".")
        return ".".join([LIBRARIES.get(first, first), *rest])
    if isinstance(node, ast.List | ast.Tuple):
        return [plain(each) for each in node.elts]
    return ast.literal_eval(node)


def converted(algorithm: str, section: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Our settings, and the names of what is left out."""
    if algorithm not in CLASSES:
        sys.exit(f"{algorithm}: is not for discrete actions; there are {', '.join(CLASSES)}")
    run = {ours: int(float(section[theirs])) for theirs, ours in OF_THE_RUN.items() if theirs in section}
    left = [name for name in LEFT_OUT if section.get(name)]
    arguments = {name: each for name, each in section.items() if name not in (*OF_THE_RUN, *LEFT_OUT)}
    if isinstance(text := arguments.get("policy_kwargs"), str):
        arguments["policy_kwargs"] = plain(ast.parse(text, mode="eval").body)
    agent = {"name": f"zoo_{algorithm}", "algorithm": CLASSES[algorithm], "policy": arguments.pop("policy")}
    agent["arguments"] = arguments
    return {"n_envs": 1, **run, "agent": agent}, left


def main(source: str, name: str, out: str) -> None:
    """Write the agent's file, and say what was left out."""
    sections = yaml.safe_load(Path(source).read_text("utf-8"))
    if name not in sections:
        sys.exit(f"{source}: has no section {name}; there are {', '.join(sections)}")
    settings, left = converted(Path(source).stem, sections[name])
    head = {"defaults": ["/agent/schema/sb3@agent", "_self_"]}
    place = Path(out)
    place.parent.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump({**head, **settings}, sort_keys=False)
    place.write_text(f"# @package _global_\n# {name} of RL Zoo's {Path(source).name}\n{text}", "utf-8")
    print(f"{out}: written; left out: {', '.join(left) or 'nothing'}")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(str(__doc__))
    main(*sys.argv[1:])
