"""The bytes of a state: whatever is packed or stored as it is comes back to the last bit."""

import numpy as np
import pytest
from helpers.resuming import differences

from gridworld.base.serialization import decode, encode


def test_a_packed_state_comes_back() -> None:
    noise = np.random.default_rng(0)
    state = {
        "weights": noise.standard_normal(50_000),
        "counts": np.arange(200_000) // 1000,
        "more": [noise.standard_normal(3), {"empty": np.zeros((2, 0)), "bytes": noise.bytes(8).hex()}],
        "late": noise.standard_normal(20_000).astype(np.float32),
    }
    packed = encode(state, compress=True)
    assert differences(decode(packed), state) == []
    assert len(packed) < 520_000  # the noise, and little of the rest
    assert len(encode(state)) > 2_000_000


@pytest.mark.parametrize(
    ("node", "sentence"),
    [
        ({1: 0}, r"state\.a\[1\]\.b: a state's keys are strings"),
        ({"@": 0}, r"state\.a\[1\]\.b: a state's keys are strings"),
        (np.array(["x"]), r"state\.a\[1\]\.b: arrays of <U1 are not part of a state"),
        ((1, 2), r"state\.a\[1\]\.b: a tuple is not part of a state"),
    ],
)
def test_what_is_no_part_of_a_state_is_named_by_its_place(node: object, sentence: str) -> None:
    with pytest.raises(TypeError, match=sentence):
        encode({"a": [0, {"b": node}]})
