"""`examine`: planted faults and those of public threads are found, and none in sound environments."""

from typing import Any

import pytest
from helpers.faulty_envs import FAULTS

from gridworld.checking.examine import examine

STEPS = 4_000
SOUND = list(dict.fromkeys(sound for sound, *_ in FAULTS))


@pytest.mark.parametrize(
    ("faulty", "topic", "words"), [each[1:] for each in FAULTS], ids=[each[1].__name__ for each in FAULTS]
)
def test_a_planted_fault_is_found(faulty: Any, topic: str, words: str) -> None:
    result = examine(faulty, steps=STEPS)
    found = {each.topic: each.evidence for each in result.findings}
    assert any(each.topic == topic and words in each.evidence for each in result.findings), found
    assert len(found) <= 2, found  # nothing far from it


@pytest.mark.parametrize("sound", SOUND, ids=[each.__name__ for each in SOUND])
def test_a_sound_environment_has_no_findings(sound: Any) -> None:
    result = examine(sound, steps=STEPS)
    assert result.passed, str(result)
