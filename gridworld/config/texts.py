"""Declaring at a schema's field what a text in the setting is, for whoever reads the settings of others.

A field that can hold text is annotated with one of the types below. The one reader of these declarations is
`gridworld.config.plain_settings`.
"""

from __future__ import annotations

import re
from enum import Enum
from typing import Annotated, Any

LIBRARIES = (  # of classes that an agent is made of
    *("torch.nn.", "torch.optim.", "stable_baselines3.", "sb3_contrib."),
    *("gridworld.agents.sb3.features.", "gridworld.agents.sb3.replay_counts."),
)
_OF_LIBRARIES = rf"({'|'.join(map(re.escape, LIBRARIES))})[\w.]+"
_OF_KEYWORD = r"[\w+-]*"


class Text(Enum):
    """What a text is: the pattern of those that do no harm, whoever wrote them, and what the others do."""

    WORD = r"(?s).*", "is a word"  # compared, looked up among the program's own, or shown
    FILE = r"[^\x00]*", "leads out of the current folder"  # nor if it is outside, by links or otherwise
    CLASS = rf"[^.]*|{_OF_LIBRARIES}", f"is from none of {', '.join(LIBRARIES)}"
    CODE = r"\?\?\?", "is called with the arguments beside it, and may write files"
    ENV = r"[^:]*", "imports the module before the colon"
    ARGUMENTS = (  # of a class of the libraries; a class may be among them, or a rate that falls
        rf"{_OF_KEYWORD}|(lin|sqrt|quad)_[\d.e+-]+|{_OF_LIBRARIES}",
        f"is no plain word, nor a class of {', '.join(LIBRARIES)}",
    )
    KWARGS = _OF_KEYWORD, "is for code that may take it for a file or a module"  # of code that is not ours

    @property
    def pattern(self) -> str:
        """Of all of a harmless text."""
        return self.value[0]

    @property
    def harm(self) -> str:
        """What another text does."""
        return self.value[1]


Word = Annotated[str, Text.WORD]
FilePath = Annotated[str, Text.FILE]
ClassPath = Annotated[str, Text.CLASS]
CodePath = Annotated[str, Text.CODE]
EnvId = Annotated[str, Text.ENV]
Callback = Annotated[Any, Text.CODE]
Arguments = Annotated[dict[str, Any], Text.ARGUMENTS]
Kwargs = Annotated[dict[str, Any], Text.KWARGS]
