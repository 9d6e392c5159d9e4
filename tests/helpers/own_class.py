"""Custom classes: an algorithm, layers, a policy, an optimiser; and settings that train any class."""

import sys
from pathlib import Path

import pytest
from helpers.support import SHORT, configure

OWN_CLASS = """
from stable_baselines3 import A2C

class Mine(A2C):
    def __init__(self, *arguments, caution=0.5, **options):
        super().__init__(*arguments, **options)
        self.caution = caution
"""


OWN_MODULES = """
import torch
from stable_baselines3.dqn.policies import DQNPolicy
from torch import nn

class Drawn(nn.Module):  # at random, in either mode
    def forward(self, x):
        return x.relu() + 0.1 * torch.randn_like(x)

class Among(nn.Module):  # looks at the other rows
    def forward(self, x):
        return x - x.mean(dim=0)

class ReLU(nn.ReLU):  # is not what it is called
    def forward(self, x):
        return super().forward(x) + self.training

class Policy(DQNPolicy): pass
class Adam(torch.optim.Adam): pass
"""


def importable(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make `own_modules` importable."""
    folder.mkdir(exist_ok=True)
    (folder / "own_modules.py").write_text(OWN_MODULES)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "own_modules", raising=False)


def any_class(algorithm: str, *overrides: str) -> list[str]:
    """A yaml of the class with no argument but gamma."""
    names = configure("agent=a2c").agent.arguments.keys() - {"gamma"}
    removed = [f"~agent.arguments.{name}" for name in sorted(names)]
    return [*SHORT["a2c"], f"agent.algorithm={algorithm}", *removed, *overrides]
