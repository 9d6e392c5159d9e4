"""What a schema declares at a field beside its default: its effect, its bounds, what its text is.

`gridworld.config.settings` reads effects, privileges and what texts are, `gridworld.config.train` bounds. A
field that declares no effect has that of the section that it is in, and affects learning where that declares
none either. A subclass with another default for a field need not repeat what its base class declares.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum, IntEnum, auto
from typing import Annotated, Any

from gridworld.base.bounds import Bounds
from gridworld.base.user_input import LIBRARIES

MISSING = "???"  # OmegaConf's sign for a value that has to be given
MOST_KEPT = 10**9  # episodes that a mean is taken over

_OF_LIBRARIES = rf"({'|'.join(map(re.escape, LIBRARIES))})[\w.]+"
_OF_KEYWORD = r"[\w+-]*"
_CALLED = "is called with the arguments given, and may write files"


class Effect(Enum):
    """On what a setting has an effect. Runs that differ in the last two alone have the same result."""

    LEARNING = auto()  # what is learned
    LENGTH = auto()  # for how long
    TASK = auto()  # what is to be learned: the world, and the discount of the evaluation
    EVALUATION = auto()  # when policies are evaluated, and at which result training ends
    SEED = auto()  # the random numbers
    MACHINE = auto()  # what it is computed on
    LABELS = auto()  # what an agent is called, and what it logs while it learns
    FILES = auto()  # what is kept beside the result
    NOTHING = auto()  # once the run has come to its end


@dataclass(frozen=True)
class Privilege:
    """What a run has by a setting with this `value`; None: with any that is not empty or 0."""

    name: str
    value: Any = None


def setting(default: Any, *declared: object) -> Any:
    """A field of a schema, and what it declares; `default` may be a class, which makes it.

    That is an effect, those of single entries of a mapping, bounds of a number, a privilege, a picture.
    """
    metadata = {Bounds if isinstance(each, Bounds) else type(each): each for each in declared}
    if isinstance(default, type):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


@functools.cache
def declared(schema: type) -> dict[str, dict[type, Any]]:
    """What each field declares, and what the base classes declare of it, by its type."""
    found: dict[str, dict[type, Any]] = {}
    for kind in reversed(schema.__mro__):
        for each in fields(kind) if is_dataclass(kind) else ():
            found[each.name] = found.get(each.name, {}) | dict(each.metadata)
    return found


class Use(IntEnum):
    """What is done with settings that a stranger may have written; each does what those before it do, too."""

    OPEN = auto()  # the agent is built; the world is the run's own, by its tables
    REPEAT = auto()  # the agent is trained, with its callbacks
    RESUME = auto()  # what is logged goes where they say
    COMPOSE = auto()  # the world is made


class Text(Enum):
    """What a text is: the pattern of those that do no harm, whoever wrote them; what others do, and when."""

    WORD = r"(?s).*", "is a word", Use.OPEN  # compared, looked up among the program's own, or shown
    CHOICE = r"\w[\w.-]*(/\w[\w.-]*)*", "leads out of the folder of choices", Use.COMPOSE
    FILE = r"[^\x00]*", "leads out of the current folder", Use.COMPOSE  # nor outside, by links or otherwise
    CLASS = rf"[^.:]*|{_OF_LIBRARIES}", f"is not from one of {', '.join(LIBRARIES)}", Use.OPEN
    UNKNOWN = r"\?\?\?", _CALLED, Use.OPEN
    CALLBACK = r"\?\?\?", _CALLED, Use.REPEAT
    BUILDER = r"\?\?\?", _CALLED, Use.COMPOSE
    SERVER = r"(?i)false", "contacts a server", Use.RESUME  # a switch
    ENV = r"[^:]*", "imports the module before the colon", Use.COMPOSE
    ARGUMENTS = (  # of a class of the libraries; a class may be among them, or a rate that falls
        rf"{_OF_KEYWORD}|(lin|sqrt|quad)_[\d.e+-]+|{_OF_LIBRARIES}",
        f"is neither a plain word nor a class of {', '.join(LIBRARIES)}",
        Use.OPEN,
    )
    KWARGS = _OF_KEYWORD, "is passed to code that may read it as a file or module", Use.COMPOSE  # not ours


Word = Annotated[str, Text.WORD]
ChoiceName = Annotated[str, Text.CHOICE]
FilePath = Annotated[str, Text.FILE]
ClassPath = Annotated[str, Text.CLASS]
BuilderPath = Annotated[str, Text.BUILDER]
EnvId = Annotated[str, Text.ENV]
Callback = Annotated[Any, Text.CALLBACK]
Contact = Annotated[bool, Text.SERVER]
Arguments = Annotated[dict[str, Any], Text.ARGUMENTS]
Rewards = Annotated[dict[str, float], Text.WORD]
Kwargs = Annotated[dict[str, Any], Text.KWARGS]
Schedule = int | float | Word
WholeNumbers = Annotated[Any, Text.WORD, "a whole number, or lists and dicts of them"]
