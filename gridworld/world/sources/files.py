"""Worlds as matrices: pymdptoolbox's layout, in an .npz, a mapping or MATLAB's .mat.

Matrices `P` (A, S, S) and `R` (S, A), (A, S, S) or (S,) are those of an .npz, or of MATLAB's .mat, where they
may be (S, S, A) as in its MDPtoolbox, or one sparse matrix for each action. A state that no action leaves and
that pays nothing is an end. Without `start` an episode starts in any other state, all equally likely.

Reference: https://pymdptoolbox.readthedocs.io
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.base.errors import InputError, in_short
from gridworld.base.user_input import COPIES, check_memory
from gridworld.world.mdp import FloatArray, resting_states
from gridworld.world.outcomes import Outcomes, check_size

ROUNDING = 1e-5  # how far a sum of probabilities in a file may be from 1, as in pomdp-solve
_MOST_UNPACKED = 2**30
_GROWTH = 8  # of a number of MATLAB's when it is read: one byte may become a double
_NUMBERS = "fiub"  # of dtypes


def dense(where: str, key: str, value: Any) -> Any:
    """`P` or `R` as one array, if it is a sparse matrix, one for each action, or MATLAB's cells."""
    from scipy import sparse

    if sparse.issparse(value):
        check_size(where, value.shape[0], 1, value.shape[-1])
        return value.toarray()
    is_cells = isinstance(value, np.ndarray) and value.dtype.kind == "O"
    parts = list(value.ravel() if is_cells else value) if is_cells or isinstance(value, list | tuple) else []
    if not any(sparse.issparse(part) or (is_cells and isinstance(part, np.ndarray)) for part in parts):
        return value
    shape = np.shape(parts[0])
    if len(shape) != 2 or any(np.shape(part) != shape for part in parts):
        raise InputError(f"{where}: {key} is a list of matrices of different shapes; all must be (S, S)")
    check_size(where, shape[0], len(parts), shape[1])
    return np.stack([part.toarray() if sparse.issparse(part) else part for part in parts])


def outcomes_of_matrices(
    where: str, transition: NDArray[Any], reward: NDArray[Any], start: NDArray[Any] | None
) -> Outcomes:
    """The outcomes of matrices `P` (A, S, S) and `R`, as the module has them."""
    shape = transition.shape
    if len(shape) != 3 or shape[1] != shape[2] or 0 in shape or transition.dtype.kind not in _NUMBERS:
        raise InputError(f"{where}: P is {transition.dtype} {shape}, must be numbers (A, S, S)")
    actions, size, _ = shape
    check_size(where, size, actions, size)
    if reward.shape not in ((size,), (size, actions), shape) or reward.dtype.kind not in _NUMBERS:
        wanted = f"({size}, {actions}), {shape} or ({size},)"
        raise InputError(f"{where}: R is {reward.dtype} {reward.shape}, must be numbers {wanted}")
    if reward.ndim < 3:
        reward = reward[None, :, None] if reward.ndim == 1 else reward.T[:, :, None]
    paid = np.broadcast_to(reward, shape).astype(np.float64)
    chance = np.swapaxes(normal(where, "P", transition.astype(np.float64)), 0, 1)
    most = int(np.count_nonzero(chance, axis=2).max())
    following = np.argsort(chance == 0, axis=2, kind="stable")[:, :, :most]
    probability = np.take_along_axis(chance, following, 2)
    pays = np.where(probability > 0, np.take_along_axis(np.swapaxes(paid, 0, 1), following, 2), 0.0)
    over = resting_states(following, probability, pays)
    if start is None:
        begins = np.ones(size) if over.all() else (~over).astype(np.float64)
        start = begins / begins.sum()
    return Outcomes(
        next_state=following,
        probability=probability,
        reward=pays,
        terminated=over[following] & (probability > 0),
        start=start,
    )


def normal(
    where: str, what: str, table: FloatArray, names: tuple[Sequence[str], Sequence[str]] | None = None
) -> FloatArray:
    """Rows of probabilities (A, S, n), made to sum to 1; `names` are of the actions and the states."""
    total = table.sum(axis=-1)
    wrong = ~((table >= 0).all(axis=-1) & (np.abs(total - 1) <= ROUNDING))
    for action, state in np.argwhere(wrong)[:1]:
        called = (action, state) if names is None else (names[0][action], names[1][state])
        raise InputError(
            f"{where}: {what} of action {called[0]}, state {called[1]} has the sum "
            f"{total[action, state]:.9g}; must be probabilities with the sum 1"
        )
    total[np.abs(total - 1) <= 1e-12] = 1  # decimals that sum to 1 stay as they are
    return np.asarray(table / total[..., None])


def mat_arrays(content: bytes, where: str) -> dict[str, Any]:
    """The arrays `P`, `R` and `start` of MATLAB's .mat, in the axes of pymdptoolbox."""
    from scipy.io import loadmat

    try:
        size = _GROWTH * _unpacked(content)
        if size > _GROWTH * _MOST_UNPACKED:
            raise InputError(f"{where}: its arrays are larger than {_MOST_UNPACKED / 2**30:.0f} GiB")
        check_memory(where, COPIES * size)
        found = loadmat(io.BytesIO(content), variable_names=["P", "R", "start"])
    except NotImplementedError:
        raise InputError(f"{where}: is a .mat of version 7.3; save it with -v7") from None
    except InputError:
        raise
    except Exception as error:  # scipy has many for what is damaged
        raise InputError(f"{where}: not a .mat that can be read ({in_short(error)})") from None
    arrays = {key: dense(where, key, found[key]) for key in ("P", "R", "start") if key in found}
    is_numbers = all(np.asarray(each).dtype.kind in _NUMBERS for each in arrays.values())
    if not (arrays.keys() >= {"P", "R"} and is_numbers):
        raise InputError(f"{where}: must contain P and R as numbers, contains {sorted(found)[:20]}")
    chance, paid = arrays["P"], arrays["R"]
    if chance.ndim == 2:  # MATLAB drops last axes of size 1
        chance, paid = chance[None], paid[None] if paid.shape == chance.shape else paid
    elif chance.ndim == 3 and chance.shape[0] == chance.shape[1]:
        is_ours = chance.shape[1] == chance.shape[2] and np.allclose(chance.sum(axis=2), 1, atol=ROUNDING)
        if not is_ours:
            chance, paid = np.moveaxis(chance, 2, 0), np.moveaxis(paid, 2, 0) if paid.ndim == 3 else paid
    arrays |= {"P": chance, "R": paid.ravel() if paid.ndim == 2 and paid.size == chance.shape[1] else paid}
    return arrays | ({"start": np.ravel(arrays["start"])} if "start" in arrays else {})


def _unpacked(content: bytes) -> int:
    """The bytes of a .mat when it is not compressed, or a few more than are allowed."""
    size, place = len(content), 128
    is_version_5 = content[:6] == b"MATLAB"
    order = ">" if content[126:128] == b"MI" else "<"
    while is_version_5 and place + 8 <= len(content) and size <= _MOST_UNPACKED:
        kind, length = struct.unpack_from(f"{order}II", content, place)
        place += 8
        if kind == 15:  # miCOMPRESSED
            packed, end = zlib.decompressobj(), min(place + length, len(content))
            for at in range(place, end, 2**16):  # of which zlib makes at most 64 MiB
                size += len(packed.decompress(content[at : min(at + 2**16, end)]))
                if size > _MOST_UNPACKED:
                    break
        place += length
    return size
