"""Worlds that other programs wrote: matrices, .mat, .MDP and .POMDP, against values that others published."""

import contextlib
import io
import itertools

import numpy as np
import pytest
from helpers.oracle import MOVES, SIDEWAYS
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.io import savemat

from gridworld import InputError, load_world
from gridworld.world.evaluation import Evaluator
from gridworld.world.solver import value_iteration
from gridworld.world.sources.arrays import build, world_bytes, world_from_bytes

# mdptoolbox.example.forest(), and its values at 0.9, in the documentation of PolicyIteration
WAIT = [[0.1, 0.9, 0.0], [0.1, 0.0, 0.9], [0.1, 0.0, 0.9]]
CUT = [[1.0, 0.0, 0.0]] * 3
P, R = np.array([WAIT, CUT]), np.array([[0.0, 0.0], [0.0, 1.0], [4.0, 2.0]])
FOREST = 26.244, 29.484, 33.484


def values(mdp, gamma):
    return Evaluator(mdp, gamma, 100).solution.v


def written(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    return path


def in_mat(tmp_path, **arrays):
    savemat(tmp_path / "forest.mat", arrays, do_compression=True)
    return load_world(tmp_path / "forest.mat")


def in_npz(tmp_path, **arrays):
    np.savez(tmp_path / "forest.npz", **arrays)
    return load_world(tmp_path / "forest.npz")


def cells(*matrices):
    found = np.empty(len(matrices), dtype=object)
    found[:] = matrices
    return found


@pytest.mark.parametrize("read", [in_npz, in_mat])
def test_the_forest_has_the_values_of_its_documentation(tmp_path, read):
    mdp = read(tmp_path, P=P, R=R)
    assert values(mdp, 0.9) == pytest.approx(FOREST, abs=1e-12)
    assert value_iteration(mdp, 0.9).q.argmax(axis=1).tolist() == [0, 0, 0]
    assert (mdp.name, mdp.action_names) == ("forest", ("0", "1"))
    assert mdp.start == pytest.approx([1 / 3] * 3)
    assert not mdp.terminal.any()


@pytest.mark.parametrize(
    ("transition", "reward"),
    [
        (P.transpose(1, 2, 0), R),  # of MATLAB's MDPtoolbox
        (P.transpose(1, 2, 0), np.repeat(R[:, None, :], 3, axis=1)),
        (P, np.repeat(R.T[:, :, None], 3, axis=2)),
        (cells(*map(sparse.csr_matrix, P)), R),
        (P, sparse.csr_matrix(R)),
    ],
)
def test_other_shapes_of_the_forest_are_the_same(tmp_path, transition, reward):
    mdp = in_mat(tmp_path, P=transition, R=reward, start=np.array([[0.0, 0.0, 1.0]]))
    assert values(mdp, 0.9) == pytest.approx(FOREST, abs=1e-12)
    assert mdp.start.tolist() == [0, 0, 1]


def test_a_cube_of_matlab_is_told_from_one_of_python_by_its_rows(tmp_path):
    cube = np.array([WAIT, CUT, CUT])  # as many actions as states
    paid = np.column_stack([R, R[:, 1]])
    for each in (cube, cube.transpose(1, 2, 0)):
        assert values(in_mat(tmp_path, P=each, R=paid), 0.9) == pytest.approx(FOREST, abs=1e-12)


def test_a_function_may_return_sparse_matrices():
    def forest():
        return {"P": [sparse.csr_matrix(each) for each in P], "R": R, "action_names": ["wait", "cut"]}

    mdp = build(forest)
    assert values(mdp, 0.9) == pytest.approx(FOREST, abs=1e-12)
    assert mdp.action_names == ("wait", "cut")


def aima():
    """The world of Russell and Norvig, rewards by states; in the last state nothing is left."""
    grid = ["...G", ".#.T", "...."]
    cells = [cell for cell in itertools.product(range(3), range(4)) if grid[cell[0]][cell[1]] != "#"]
    chance, paid = np.zeros((4, 12, 12)), np.full(12, -0.04)
    for state, (row, col) in enumerate(cells):
        for action, (direction, share) in itertools.product(MOVES, enumerate((0.8, 0.1, 0.1))):
            down, right = MOVES[(action, *SIDEWAYS[action])[direction]]
            target = (row + down, col + right) if (row + down, col + right) in cells else (row, col)
            chance[action, state, cells.index(target) if grid[row][col] == "." else 11] += share
    paid[[3, 6, 11]] = 1, -1, 0
    chance[:, 11, 11] = 1
    return chance, paid


# Artificial Intelligence: A Modern Approach, figure 17.3, row by row
UTILITIES = 0.812, 0.868, 0.918, 1, 0.762, 0.660, -1, 0.705, 0.655, 0.611, 0.388


def test_rewards_of_states_and_an_absorbing_end(tmp_path):
    chance, paid = aima()
    mdp = in_npz(tmp_path, P=chance, R=paid)
    assert values(mdp, 1.0)[:11] == pytest.approx(UTILITIES, abs=6e-4)
    assert mdp.start[:11] == pytest.approx([1 / 11] * 11)  # anywhere but at the end
    assert mdp.start[11] == 0
    ends = [(11, True), (11, False)]  # one is a success
    assert sorted(zip(mdp.number[mdp.terminal], mdp.goal[mdp.terminal], strict=True)) == sorted(ends)


def mdp_text(form):
    """The same world as an .MDP, its matrices in one of the forms that the format has."""
    chance, _ = aima()
    lines = ["discount: 0.95 # not used", "values: " + ("cost" if form == "cost" else "reward")]
    names = [f"at-{state}" for state in range(11)] + ["over"]
    lines += [
        "states: " + ("12" if form == "numbers" else " ".join(names)),
        "actions: up right",
        " down left",
    ]
    lines.append({"numbers": "start: 7", "cost": "start include: at-7"}.get(form, "start: at-7"))
    for action, name in enumerate(("up", "right", "down", "left")):
        if form == "matrix":
            lines += [f"T: {name}", *(" ".join(map(repr, row)) for row in chance[action].tolist())]
        elif form == "rows":
            for state in range(12):
                lines += [f"T : {name} : {state}", " ".join(map(repr, chance[action, state].tolist()))]
        else:
            lines.append(f"T: {name}\nidentity")
            for state in range(11):
                lines.append(f"T: {name} : {state if form == 'numbers' else names[state]} : * 0.0")
                for target in np.flatnonzero(chance[action, state]):
                    lines.append(f"T: {action}: {state} :{target} {float(chance[action, state, target])!r}")
    sign = -1 if form == "cost" else 1
    lines.append(f"R: * : * : * {-0.04 * sign!r}\nR: * : 3 : * {1.0 * sign!r}")
    if form == "matrix":
        lines.append("R: down : 6\n" + "-1 " * 12)
        lines += [f"R: {name} : 6\n" + "-1.0 " * 12 for name in ("up", "right", "left")]
    else:
        lines.append(f"R: * : 6 : * : * {-1.0 * sign!r}")
    return "\n".join([*lines, "R: * : 11 : * 0"]) + "\n"


@pytest.mark.parametrize("form", ["names", "numbers", "cost", "matrix", "rows"])
def test_every_form_of_an_mdp_says_the_same(tmp_path, form):
    mdp = load_world(written(tmp_path, "aima.MDP", mdp_text(form)))
    assert values(mdp, 1.0)[:11] == pytest.approx(UTILITIES, abs=6e-4)
    assert mdp.action_names == ("up", "right", "down", "left")
    assert (mdp.state_name(6), mdp.name) == ("6" if form == "numbers" else "at-6", "aima")
    assert mdp.start_states.tolist() == [7]
    again = world_from_bytes(world_bytes(mdp), "world.npz")
    assert again.digest() == mdp.digest()
    assert again.state_names == mdp.state_names


@pytest.mark.parametrize(
    ("start", "expected"),
    [
        ("", [1 / 3] * 3),
        ("start: uniform", [1 / 3] * 3),
        ("start: 0.25 0.25 0.5", [0.25, 0.25, 0.5]),
        ("start: 0.333333 0.333333 0.333333", [1 / 3] * 3),
        ("start include: a 2", [0.5, 0, 0.5]),
        ("start exclude: b", [0.5, 0, 0.5]),
        ("start: c", [0, 0, 1]),
    ],
)
def test_every_form_of_a_start(tmp_path, start, expected):
    text = f"states: a b c\nactions: 1\n{start}\nT: * uniform\nT: 0 : c reset\nR: * : * : * 1"
    mdp = load_world(written(tmp_path, "start.mdp", text))
    assert mdp.start == pytest.approx(expected)
    reset = np.zeros(3)
    reset[mdp.next_state[2, 0]] += mdp.probability[2, 0]
    assert reset == pytest.approx(expected if start else [1 / 3] * 3)


GOOD = "states: a b\nactions: x y\nT: * uniform\nR: * : * : * 1\n"
WATCHED = "states: a b\nactions: x y\nobservations: u v\nT: * uniform\nO: * uniform\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "line 1: there are no states"),
        ("states: 2\nT: 0 uniform", "line 2: there are no actions; they must come before"),
        ("states: 2\nactions: 1\n\nT: 0 : 0 uniform", "T of action 0, state 1 has the sum 0; must be prob"),
        ("states: 0\n", "line 1: states must be how many, from 1 to 1,048,576, or different names"),
        ("states: 9999999\n", "line 1: states must be how many"),
        ("states: a a\n", "line 1: states must be how many"),
        ("states: 1a b\n", "line 1: states must be how many"),
        ("states: a\u202e b\n", "the name of a state is "),
        (
            "states: 200000\nactions: 2\nT: 0 identity",
            "200,000 states, 2 actions and 200,000 outcomes of each",
        ),
        ("values: profit", "line 1: values must be reward or cost"),
        ("discount: 2", "line 1: discount must be a number from 0 to 1"),
        ("discount 0.9", "line 1: '0.9' is here where ':' must be"),
        ("# only\nhello: 3", "line 2: 'hello' is here where one of O, R, T, actions, "),
        (GOOD + "states: 3", "line 5: states must come before all of T, O and R"),
        (GOOD + "O: * uniform", "line 5: O is here, but there are no observations"),
        (GOOD + "T: z uniform", "line 5: unknown action 'z'; must be a name or a number up to 1"),
        (GOOD + "T: x : 7 uniform", "line 5: unknown state '7'; must be a name or a number up to 1"),
        (GOOD + "T: x : a : b : c 1", "line 5: T needs 1 number here, not 0, and then ':'"),
        (GOOD + "T: x\n0.5 0.5\n1", "line 7: T needs 4 numbers here, not 3, and then ''"),
        (GOOD + "T: x : a\n0.5 half", "line 6: T needs 2 numbers here, not 1, and then 'half'"),
        (GOOD + "T: x : a\n0.5 0.5 0.5", "line 6: T needs 2 numbers here, not more"),
        (GOOD + "T: x : a\n0.5 0.4", "T of action x, state a has the sum 0.9; must be probabilities"),
        (GOOD + "T: x : a\n1.5 -0.5", "T of action x, state a has the sum 1; must be probabilities"),
        (GOOD + "T: x : a identity", "line 5: T needs 2 numbers here, not 0, and then 'identity'"),
        (GOOD + "R: x : a uniform", "line 5: R needs 2 numbers here, not 0, and then 'uniform'"),
        (GOOD + "R: x : a : b 1e999", "line 5: R has a number here that is too large"),
        (GOOD + "start: 0.5 0.4", "line 5: start must be 2 probabilities with the sum 1, or states"),
        (GOOD + "start: c", "line 5: unknown state 'c'"),
        (GOOD + "start exclude: a b", "line 5: start leaves no state to start in"),
        ("start: uniform", "line 1: start must come after states"),
        (WATCHED + "O: x : a : u 0.9", "O of action x, state a has the sum 1.4"),
        (
            WATCHED + "R: x : a : b : w 1",
            "line 6: unknown observation 'w'; must be a name or a number up to 1",
        ),
        (WATCHED + "R: x : a : b 1", "line 6: R needs 2 numbers here, not 1, and then ''"),
    ],
)
def test_what_is_wrong_with_a_text_is_told_with_its_line(tmp_path, text, told):
    path = written(tmp_path, "wrong.POMDP", text)
    with pytest.raises(InputError) as raised:
        load_world(path)
    assert str(raised.value).startswith(f"{path}: {told}")
    assert "\n" not in str(raised.value)


def test_decimals_are_exact(tmp_path):
    rows = "T: *\n0.7 0.2 0.1\n0.333333 0.333333 0.333333\n0 0 1\n"
    mdp = load_world(written(tmp_path, "thirds.mdp", f"states: a b c\nactions: 1\n{rows}R: * : * : * 1"))
    assert mdp.probability[0, 0].tolist() == [0.7, 0.2, 0.1]
    assert mdp.probability[1, 0] == pytest.approx([1 / 3] * 3, abs=1e-15)


def test_beliefs_of_thirds_have_an_end(tmp_path):
    text = """
        states: a b c
        actions: 1
        observations: 2
        start: a
        T: *
        0.333333 0.333333 0.333333
        0.666667 0.333333 0.0
        0.333333 0.333333 0.333333
        O: * : * : 0 1
        O: 0 : c
        0.1 0.9
        O: 0 : b
        0.0 1.0
        R: * : a : * : * 1
        """
    with pytest.raises(InputError, match=r"thirds\.pomdp: its observations do not show its state"):
        load_world(written(tmp_path, "thirds.pomdp", text))
    mdp = load_world(
        written(tmp_path, "thirds.pomdp", text.replace("0.666667 0.333333 0.0", "0.333333 " * 3))
    )
    assert mdp.truth.startswith("exact, 3 beliefs about 3 hidden states")
    assert sorted(mdp.probability[0, 0]) == pytest.approx([1.1 / 3, 1.9 / 3], abs=1e-15)


# Kaelbling, Littman and Cassandra, Planning and acting in partially observable stochastic domains, 1998
TIGER = """
discount: 0.75
values: reward
states: tiger-left tiger-right
actions: listen open-left open-right
observations: hear-left hear-right

T: listen identity
T: open-left uniform
T: open-right uniform
O: listen
{right} {wrong}
{wrong} {right}
O: open-left uniform
O: open-right uniform
R: listen : * : * : * -1
R: open-left : tiger-left : * : * -100
R: open-left : tiger-right : * : * 10
R: open-right : tiger-left : * : * 10
R: open-right : tiger-right : * : * -100
"""


def test_beliefs_without_end_are_refused(tmp_path):
    path = written(tmp_path, "tiger.POMDP", TIGER.format(right=0.85, wrong=0.15))
    told = r"tiger.POMDP: its observations do not show its state, .* no end .* there are more; only a POMDP"
    with pytest.raises(InputError, match=told):
        load_world(path)


def test_a_tiger_that_is_always_heard(tmp_path):
    mdp = load_world(written(tmp_path, "tiger.POMDP", TIGER.format(right="1.0", wrong="0.0")))
    # listen, then open: -1 + 0.75 * 10, again and again
    assert Evaluator(mdp, 0.75, 100).optimal_value == pytest.approx(6.5 / (1 - 0.75**2), abs=1e-9)
    assert mdp.truth == "exact, 5 beliefs about 2 hidden states; 2 observations stand for several of them"
    assert mdp.state_name(0) == "tiger-left 0.5, tiger-right 0.5"
    again = world_from_bytes(world_bytes(mdp), "world.npz")
    assert again.digest() == mdp.digest()


CHEESE = ["01234", "5#6#7", "8#a#9"]
SHOWN = [[0], [1, 3], [2], [4], [5, 6, 7], [8, 9], [10]]  # states that look alike


def cheese(start):
    """McCallum's maze: walls beside the mouse are all it sees, and it starts anew when it has the cheese."""
    places = {
        (r, c): int(tile, 16) for r, row in enumerate(CHEESE) for c, tile in enumerate(row) if tile != "#"
    }
    lines = [f"states: 11\nactions: n e s w\nobservations: {len(SHOWN)}", f"start include: {start}"]
    for (row, col), state in places.items():
        for action, (down, right) in MOVES.items():
            target = places.get((row + down, col + right), state)
            lines.append(f"T: {action} : {state} : {target} 1.0")
    lines += ["T: * : 10", "0.1 " * 10 + "0.0"]
    lines += [f"O: * : {state} : {shown} 1.0" for shown, group in enumerate(SHOWN) for state in group]
    return "\n".join([*lines, "R: * : * : 10 : * 1.0"])


def test_the_cheese_maze_has_the_value_of_its_beliefs_that_others_found(tmp_path):
    # Allen et al., Mitigating partial observability in sequential decision processes via the lambda
    # discrepancy, 2024: 3.57887962950754 in the mean over what is seen before the first action
    total = 0.0
    for group in SHOWN[:-1]:
        mdp = load_world(written(tmp_path, "cheese.POMDP", cheese(" ".join(map(str, group)))))
        total += len(group) / 10 * Evaluator(mdp, 0.95, 100).optimal_value
    assert total == pytest.approx(3.57887962950754, abs=1e-9)
    assert mdp.own_observation.max() == len(SHOWN)  # what is shown before anything is


def expected_return(tables, start, steps):
    """The best return of histories, which are tried one by one."""
    chance, shows, pays = tables

    def best(belief, left):
        if left == 0:
            return 0.0
        found = []
        for action in range(len(chance)):
            joint = belief[:, None, None] * chance[action][:, :, None] * shows[action][None]
            total = (joint * pays[action]).sum()
            for observation in range(shows.shape[2]):
                after = joint[:, :, observation].sum(axis=0)
                if after.sum() > 0:
                    total += 0.9 * after.sum() * best(after / after.sum(), left - 1)
            found.append(total)
        return max(found)

    return best(np.array(start), steps)


LOTTERY = """
    states: left right over
    actions: wait bet
    observations: dull bright end
    start: 0.5 0.5 0.0
    T: wait identity
    T: bet uniform
    T: bet : over : * 0
    T: bet : over : over 1
    O: *
    1 0 0
    1 0 0
    0 0 1
    O: wait : left
    0 1 0
    R: bet : left : right
    2 -3 0
    R: bet : right
    0.5 1 0
    4 0 0
    0 0 -6
    R: wait : left : left : bright -0.25
"""


def test_beliefs_are_worth_what_their_histories_are(tmp_path):
    chance = np.array([np.eye(3), [[1 / 3] * 3, [1 / 3] * 3, [0, 0, 1]]])
    shows, pays = np.zeros((2, 3, 3)), np.zeros((2, 3, 3, 3))
    shows[:, :2, 0], shows[:, 2, 2], shows[0, 0] = 1, 1, (0, 1, 0)
    pays[1, 0, 1], pays[1, 1] = (2, -3, 0), [[0.5, 1, 0], [4, 0, 0], [0, 0, -6]]
    pays[0, 0, 0, 1] = -0.25
    mdp = load_world(written(tmp_path, "lottery.pomdp", LOTTERY))
    for steps in range(1, 7):
        ahead = np.zeros(mdp.num_states)
        for _ in range(steps):
            ahead = (mdp.probability * (mdp.reward + 0.9 * ahead[mdp.next_state])).sum(axis=2).max(axis=1)
        wanted = expected_return((chance, shows, pays), [0.5, 0.5, 0.0], steps)
        assert mdp.start @ ahead == pytest.approx(wanted, abs=1e-12)
    assert {mdp.state_name(state) for state in np.flatnonzero(mdp.terminal)} == {"over"}


@pytest.mark.parametrize(
    ("arrays", "told"),
    [
        ({"P": P}, "has no R, must contain P, R"),
        ({"P": P[0], "R": R}, r"P is float64 \(3, 3\), must be numbers \(A, S, S\)"),
        ({"P": P, "R": R.T}, r"R is float64 \(2, 3\), must be numbers \(3, 2\), \(2, 3, 3\) or \(3,\)"),
        ({"P": 2 * P, "R": R}, "P of action 0, state 0 has the sum 2; must be probabilities"),
        ({"P": P, "R": R, "reward": R}, "reward is not an array of a world; optional are start"),
        ({"P": P, "R": R, "start": np.ones(3)}, "start is .*, with sum 3; must be probabilities"),
        ({"P": np.array([1, "a"], dtype=object), "R": R}, "cannot be loaded when allow_pickle=False"),
        ({"P": np.zeros((2, 9000, 9000), np.int8), "R": R}, "9,000 states, 2 actions and 9,000 outcomes"),
    ],
)
def test_what_is_wrong_with_matrices(tmp_path, arrays, told):
    np.savez_compressed(tmp_path / "forest.npz", **arrays)
    with pytest.raises(InputError, match=f"forest.npz: .*{told}"):
        load_world(tmp_path / "forest.npz")


def test_what_is_no_mat(tmp_path, monkeypatch):
    content = io.BytesIO()
    savemat(content, {"P": P, "R": R}, do_compression=True)
    good = content.getvalue()
    ours = io.BytesIO()
    savemat(ours, {"P": P, "Q": R})
    names = io.BytesIO()
    savemat(names, {"P": P, "R": "text"})
    wide = io.BytesIO()
    savemat(
        wide, {"P": cells(sparse.csr_matrix((99_999, 99_999)), sparse.csr_matrix((99_999, 99_999))), "R": R}
    )
    for each, told in (
        (b"", "not a .mat that can be read"),
        (good[:200], "not a .mat that can be read"),
        (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF", "of version 7.3; save it with -v7"),
        (ours.getvalue(), r"must contain P and R as numbers, contains .*'P'"),
        (names.getvalue(), "must contain P and R as numbers"),
        (wide.getvalue(), "99,999 states, 2 actions and 99,999 outcomes of each would take"),
    ):
        (tmp_path / "wrong.mat").write_bytes(each)
        with pytest.raises(InputError, match=f"wrong.mat: .*{told}"):
            load_world(tmp_path / "wrong.mat")
    bomb = io.BytesIO()
    savemat(bomb, {"P": np.zeros((1, 2**20)), "R": R}, do_compression=True)
    monkeypatch.setattr("gridworld.world.sources.files._MOST_UNPACKED", 2**20)
    (tmp_path / "bomb.mat").write_bytes(bomb.getvalue())
    with pytest.raises(InputError, match=r"bomb.mat: its arrays are larger than"):
        load_world(tmp_path / "bomb.mat")


def test_texts_have_a_largest_size(tmp_path, monkeypatch):
    monkeypatch.setattr("gridworld.world.sources.arrays._MOST_TEXT", 2**20)
    path = written(tmp_path, "long.MDP", GOOD + "#" * 2**20)
    with pytest.raises(InputError, match=r"long.MDP: is larger than 1 MiB; give a smaller one"):
        load_world(path)
    path.write_bytes(b"states: \xff")
    with pytest.raises(InputError, match=r"long.MDP: not a text file \(byte 9 is not UTF-8\)"):
        load_world(path)


@settings(deadline=None)
@given(st.integers(0, len(TIGER)), st.text("T:OR*. 0139ae-\n#", max_size=4))
def test_a_text_that_was_changed_is_refused_or_a_world(tmp_path_factory, position, inserted):
    text = TIGER.format(right="1.0", wrong="0.0")
    path = written(
        tmp_path_factory.mktemp("text"), "t.pomdp", text[:position] + inserted + text[position + 2 :]
    )
    with contextlib.suppress(InputError):
        assert load_world(path).num_actions in (1, 2, 3, 4)
