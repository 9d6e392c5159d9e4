"""Check how good a policy is by its certificate, in exact fractions: `python3 -I check_certificate.py FILE`.

An action is worth q(x) = Σ p (r + γ x(next)), where x is 0 in what has ended. In all states let `upper` be at
least q(upper) of every action, and where the policy goes `lower` at most q(lower) of its own. Then no policy
earns more than `upper`, nor this one less than `lower`. At γ = 1 what never ends must be ruled out: no upper
bound is below 0, or all that goes on costs; no lower bound is above 0, or `steps` bounds how long it goes on.
"""

import gzip
import hashlib
import json
import math
import sys
from fractions import Fraction

KEYS = ["claim", "digest", "ended", "gamma", "lower", "policy", "scope", "start", "steps", "upper", "world"]
MOST_BYTES, ROUNDING = 2**31, Fraction(1, 10**12)


def need(holds, what):
    if not holds:
        raise ValueError(what)


def once(pairs):
    need(len(pairs) == len(dict(pairs)), "a key comes twice")
    return dict(pairs)


def shares(rows, where):  # of a whole, to which floats add up but for rounding
    total = sum((row[0] for row in rows), Fraction(0))
    need(abs(total - 1) < ROUNDING and min(row[0] for row in rows) > 0, f"{where}: shares do not add up to 1")
    return [(share / total, str(state), *paid) for share, state, *paid in rows]


def check(given):
    """The regret from the start is at most the first, and the policy is worth at least the second."""
    need(sorted(given) == KEYS and 0 <= given["gamma"] <= 1, f"not the keys {KEYS}, or not a discount")
    gamma, policy, upper, lower = (given[name] for name in ("gamma", "policy", "upper", "lower"))
    rows = {s: [shares(row, f"state {s}") for row in actions] for s, actions in given["world"].items()}
    ended = {str(state) for state in given["ended"]} - rows.keys()
    start = shares([(share, state) for state, share in given["start"]], "start")
    need((upper.keys(), lower.keys()) == (rows.keys(), policy.keys()), "bounds: not of the states needed")
    for state, actions in rows.items():
        need(ended | rows.keys() >= {s for row in actions for _, s, _ in row}, f"{state}: leads nowhere")
        best = max(sum(p * (r + gamma * upper.get(s, 0)) for p, s, r in row) for row in actions)
        need(best <= upper[state], f"{state}: an action is worth more than the bound")
    for state, action in policy.items():
        need(ended | policy.keys() >= {s for _, s, _ in rows[state][action]}, f"{state}: leads out of it")
        own = sum(p * (r + gamma * lower.get(s, 0)) for p, s, r in rows[state][action])
        need(own >= lower[state] and action >= 0, f"{state}: the policy is worth less than its bound")
    need(ended | policy.keys() >= {s for _, s in start}, "start: not where the policy acts")
    if gamma == 1:
        costs = (r < 0 for actions in rows.values() for row in actions for _, s, r in row if s not in ended)
        need(min(upper.values(), default=0) >= 0 or all(costs), "upper: proves nothing without a discount")
        for s, a in policy.items() if max(lower.values(), default=0) > 0 else ():
            left = sum(p * (0 if then in ended else given["steps"][then]) for p, then, _ in rows[s][a])
            need(given["steps"][s] >= 1 + left, f"state {s}: the policy may go on for longer")
    worth = sum(p * lower.get(s, 0) for p, s in start)
    return sum(p * upper.get(s, 0) for p, s in start) - worth, worth


def parsed(text):
    exact = {"parse_float": lambda number: Fraction(float(number)), "parse_constant": Fraction}  # refuses NaN
    return json.loads(text, object_pairs_hook=once, **exact)


def digest_of(given):
    tables = json.dumps([given[name] for name in ("gamma", "start", "world", "ended")], sort_keys=True)
    return hashlib.sha256(tables.encode()).hexdigest()[:16]


if __name__ == "__main__":
    for path in sys.argv[1:]:
        try:
            with (gzip.open if path.endswith(".gz") else open)(path, "rb") as file:
                need(len(text := file.read(MOST_BYTES + 1)) <= MOST_BYTES, f"more than {MOST_BYTES:,} bytes")
            (regret, worth), given = check(parsed(text)), json.loads(text)
            need(given["digest"] == digest_of(given), "digest: not that of its rows")
        except Exception as error:  # whatever is wrong with a file, it proves nothing
            sys.exit(f"{path}: DOES NOT HOLD: {error or type(error).__name__}")
        most, least = (float(each) for each in (regret, worth))  # rounded, and now outwards
        most = most if most >= regret else math.nextafter(most, math.inf)
        least = least if least <= worth else math.nextafter(least, -math.inf)
        print(f"{path}: holds. The policy earns at least {least}, and no policy earns {most} more than that.")
        print(f"  Rows {digest_of(given)}, {len(given['world']):,} states, known like this: {given['scope']}")
