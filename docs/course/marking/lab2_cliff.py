"""How Lab 2 is marked: targets by exact backups, learning by the certificate, returns by the chain."""

from collections.abc import Iterator

import numpy as np
from grading import Work, WrongAnswerError, exercise, numbers

from gridworld import Evaluator, Mdp, compile_mdp
from gridworld.agents.tabular.td_control import epsilon_greedy
from gridworld.diagnosis.evidence import optimum_of_epsilon
from gridworld.world.chain import Chain
from gridworld.world.layout import parse
from gridworld.world.mdp import backup
from gridworld.world.solver import solved

PUBLIC = {"sizes": [[3, 4]]}  # of cliffs: rows and columns; `hidden/` has others
GAMMA, EPSILON = 0.95, 0.2


def cliff(rows: int, columns: int, slip: float = 0.0) -> Mdp:
    """A cliff like the sheet's, of another size."""
    text = ("." * columns + "\n") * (rows - 1) + f"S{'C' * (columns - 2)}G\n"
    rewards = {"step_reward": -1.0, "goal_reward": 0.0, "trap_reward": -99.0}
    return compile_mdp(parse(text, f"a cliff of {rows} x {columns}"), slip=slip, **rewards)


def path(mdp: Mdp, rows: int, columns: int, row: int) -> np.ndarray:
    """The actions (S,) that go to a row, along it and down."""
    actions = np.full((rows, columns), 1)
    actions[row + 1 :, :-1], actions[:row], actions[:, -1] = 0, 2, 2
    return actions.ravel()


def at_start(mdp: Mdp, policy: np.ndarray, gamma: float) -> float:
    """The exact expected return of a policy (S, A) from the start."""
    return float(Chain(mdp, policy).value(gamma)[mdp.start_states].mean())


def targets(work: Work, function: str, policy: np.ndarray | None) -> None:
    """The mean target of a state and action must be the backup of its own values."""
    mdp, rng = cliff(3, 4, slip=0.3), np.random.default_rng(2)
    q = rng.normal(size=(mdp.num_states, mdp.num_actions))
    values = q.max(axis=1) if policy is None else (policy * q).sum(axis=1)
    exact = backup(mdp, np.where(mdp.terminal, 0.0, values), GAMMA)
    for state, action in ((0, 1), (1, 2), (2, 1), (7, 2), (7, 3)):
        mean = 0.0
        for k, probability in enumerate(mdp.probability[state, action]):
            reached = int(mdp.next_state[state, action, k])
            given = (float(mdp.reward[state, action, k]), reached)
            ended = bool(mdp.terminal[reached])
            for following in range(mdp.num_actions):
                weight = 1 / mdp.num_actions if policy is None else policy[reached, following]
                more = () if policy is None else (following,)
                found = work.array(function, q, *given, *more, ended, GAMMA, shape=())
                mean += float(probability * weight * found)
        if not abs(mean - exact[state, action]) <= 1e-9:
            ends = " that may end the episode" if mdp.terminal[mdp.next_state[state, action]].any() else ""
            raise WrongAnswerError(f"the mean of `{function}` is not the exact backup after a step{ends}")


def trained(
    work: Work, algorithm: str, alpha: float, episodes: int, seed: int = 0
) -> Iterator[tuple[str, Mdp, np.ndarray]]:
    for rows, columns in PUBLIC["sizes"]:
        mdp = cliff(rows, columns)
        found = work.call("train", mdp, algorithm, episodes, EPSILON, alpha, GAMMA, seed)
        if not isinstance(found, list) or len(found) != 2:
            raise WrongAnswerError("`train` must return q and a list with the return of each episode")
        q = numbers("the q of `train`", found[0], mdp.next_state.shape[:2])
        returns = numbers("the returns of `train`", found[1], (episodes,))
        strange = [each for each in returns if each > -columns - 1 or each % 1]
        if strange:
            raise WrongAnswerError(
                f"`train` has the return {strange[0]:.4g} at {mdp.name}, which no episode has; sum all its "
                "rewards without a discount"
            )
        unmoved = work.call("train", mdp, algorithm, 1, 1.0, 0.0, GAMMA, seed)[0]
        if numbers("the q of `train`", unmoved, q.shape).any():
            raise WrongAnswerError("`train` changes q with alpha = 0; q must begin with 0, and move by alpha")
        yield mdp.name, mdp, q


@exercise("2.1 epsilon-greedy", points=2)
def exploring(work: Work) -> str:
    for epsilon in (0.0, 0.3, 1.0):
        q = np.random.default_rng(1).integers(0, 3, (40, 4)).astype(float)  # with ties
        found = work.array("epsilon_greedy", q, epsilon, shape=q.shape)
        wrong = np.abs(found - epsilon_greedy(q, epsilon)).max(axis=1) > 1e-9
        if wrong.any():
            raise WrongAnswerError(f"`epsilon_greedy` is wrong for the row {q[wrong.argmax()].tolist()}")
    return "right, with ties"


@exercise("2.2 target of Q-learning", points=2)
def target_of_q_learning(work: Work) -> str:
    targets(work, "q_learning_target", None)
    return "its mean is the exact backup"


@exercise("2.3 target of SARSA", points=2)
def target_of_sarsa(work: Work) -> str:
    policy = np.random.default_rng(3).dirichlet(np.ones(4), 12)
    targets(work, "sarsa_target", policy)
    return "its mean is the exact backup"


@exercise("2.4 Q-learning", points=4)
def q_learning(work: Work) -> str:
    for name, mdp, q in trained(work, "q_learning", alpha=0.5, episodes=600):
        score = Evaluator(mdp, GAMMA, 100).score(np.eye(4)[q.argmax(axis=1)])
        if not score.certified:
            raise WrongAnswerError(f"its greedy policy has a regret of {score.regret:.2g} at {name}")
    return "its greedy policies are certified optimal"


@exercise("2.5 SARSA", points=3)
def sarsa(work: Work) -> str:
    why = ""
    for seed in range(3):  # it is noisy: 5 of 300 right trainings failed
        for name, mdp, q in trained(work, "sarsa", alpha=0.1, episodes=2000, seed=seed):
            best, edge = optimum_of_epsilon(mdp, GAMMA, EPSILON), solved(mdp, GAMMA).q
            greedy = (np.eye(4)[table.argmax(axis=1)] for table in (best, edge, q))
            online = [at_start(mdp, epsilon_greedy(table, EPSILON), GAMMA) for table in greedy]
            lost = (online[0] - online[2]) / (online[0] - online[1])
            if not lost <= 0.6:
                why = f"at {name} its policy loses {lost:.0%} of what walking along the edge loses on-line"
                break
        else:
            return "its policies are close to the best that explore"
    raise WrongAnswerError(f"{why}, three times more than 60%")


@exercise("2.6 on-line and greedy returns", points=4)
def both_returns(work: Work) -> str:
    for rows, columns in PUBLIC["sizes"]:
        mdp = cliff(rows, columns)
        for epsilon in (0.0, 0.1, 0.4):
            q = np.eye(4)[path(mdp, rows, columns, rows - 2)] * 0.5 + solved(mdp, 0.9).optimal
            q[1 : columns - 1] = 0  # ties, where only exploration leads
            q[0] = [1, 0, 0, 0]  # it stays there for ever, but never comes there
            found = work.array("returns", mdp, q, epsilon, shape=(2,))
            policies = (np.eye(4)[q.argmax(axis=1)], epsilon_greedy(q, epsilon))
            exact = [at_start(mdp, policy, 1.0) for policy in policies]
            for which, mine, true in zip(("greedy", "on-line"), found, exact, strict=True):
                if not abs(mine - true) <= 1e-6 * abs(true):
                    where = f"{mdp.name} is wrong for epsilon {epsilon:g}"
                    raise WrongAnswerError(f"the {which} return at {where}")
    return "both are exact at all cliffs"


@exercise("2.7 where the detour pays", points=3)
def where_the_detour_pays(work: Work) -> str:
    for rows, columns in PUBLIC["sizes"]:
        mdp = cliff(rows, columns)
        edge, detour = (path(mdp, rows, columns, row) for row in (rows - 2, rows - 3))
        found = float(work.array("crossing", mdp, edge, detour, shape=()))
        if not 0 <= found - 0.001 < found + 0.001 <= 1:
            raise WrongAnswerError(f"`crossing` returned {found:.4g}, must be between 0 and 0.5")
        gains = []
        for epsilon in (found - 0.001, found + 0.001):
            explored = (epsilon_greedy(np.eye(4)[actions], epsilon) for actions in (edge, detour))
            first, second = (at_start(mdp, policy, 1.0) for policy in explored)
            gains.append(second - first)
        if not gains[0] < 0 < gains[1]:
            raise WrongAnswerError(f"at {mdp.name} the two are not equally good at epsilon {found:.4g}")
    return "right at all cliffs"
