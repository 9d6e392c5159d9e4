"""Check how good a policy is by its certificate, in exact fractions: `python3 -I check_certificate.py FILE`.

An action is worth q(x) = Σ p (r + γ x(next)), where x is 0 in what has ended. In all states let `upper` be at
least q(upper) of every action, and where the policy goes `lower` at most q(lower) of its own. Then no policy
earns more than `upper`, nor this one less than `lower`. At γ = 1 what never ends must be ruled out: no upper
bound is below 0, or all but ends costs; no lower bound is above 0, or the policy ends in `steps` on average.
"""

import gzip
import hashlib
import json
import math
import sys
from fractions import Fraction

KEYS = ["claim", "digest", "ended", "gamma", "lower", "policy", "scope", "start", "steps", "upper", "world"]
MOST_BYTES, ROUNDING = 2**28, Fraction(1, 10**12)


def need(holds, what):
    if not holds:
        raise ValueError(what)


def once(pairs):
    need(len(pairs) == len(dict(pairs)), "a key comes twice")
    return dict(pairs)


def checked(row, where):  # of probabilities, which add up to 1 but for rounding
    need(abs(sum(p for p, *_ in row) - 1) < ROUNDING, f"{where}: its probabilities do not add up to 1")
    need(min(p for p, *_ in row) > 0, f"{where}: a probability is not above 0")
    return [(p + Fraction(0), str(state), *paid) for p, state, *paid in row]


def mean(row, bound, gamma=1):
    total = sum(p * (sum(paid) + gamma * bound.get(state, 0)) for p, state, *paid in row)
    return total / sum(p for p, *_ in row)


def check(given):
    """From the start no policy is worth more than the first, and this one at least the second."""
    need(sorted(given) == KEYS and 0 <= given["gamma"] <= 1, f"not the keys {KEYS}, or not a discount")
    gamma, policy, upper, lower = (given[name] for name in ("gamma", "policy", "upper", "lower"))
    rows = {s: [checked(row, f"state {s}") for row in actions] for s, actions in given["world"].items()}
    ended = {str(state) for state in given["ended"]} - rows.keys()
    known, entered = ended | rows.keys(), ended | policy.keys()
    start = checked([(p, state) for state, p in given["start"]], "start")
    need((upper.keys(), lower.keys()) == (rows.keys(), policy.keys()), "bounds: not of the states needed")
    for state, actions in rows.items():
        need(known >= {s for row in actions for _, s, _ in row}, f"{state}: leads nowhere")
        best = max(mean(row, upper, gamma) for row in actions)
        need(best <= upper[state], f"{state}: an action is worth more than the bound")
    for state, action in policy.items():
        need(entered >= {s for _, s, _ in rows[state][action]}, f"{state}: leads out of it")
        own = mean(rows[state][action], lower, gamma)
        need(own >= lower[state] and action >= 0, f"{state}: the policy is worth less than its bound")
    need(entered >= {s for _, s in start}, "start: not where the policy acts")
    if gamma == 1:
        costs = (r < 0 for actions in rows.values() for row in actions for _, s, r in row if s not in ended)
        need(min(upper.values(), default=0) >= 0 or all(costs), "upper: proves nothing without a discount")
    if gamma == 1 and max(lower.values(), default=0) > 0:
        need(given["steps"].keys() == policy.keys(), "steps: not of the states where the policy acts")
        for s, most in given["steps"].items():
            left = mean([(p, then) for p, then, _ in rows[s][policy[s]]], given["steps"])
            need(most >= 1 + left, f"state {s}: the policy may take longer")
    need(isinstance(given["scope"], str) and len(given["scope"]) < 2000, "scope: not a sentence")
    return mean(start, upper), mean(start, lower)


def outwards(number, towards):  # the nearest float that is not on the other side
    near = float(number)
    return near if near == number or (near > number) == (towards > 0) else math.nextafter(near, towards)


def parsed(text):
    exact = {"parse_float": lambda number: Fraction(float(number)), "parse_constant": Fraction}  # refuses NaN
    return json.loads(text, object_pairs_hook=once, **exact)


def digest_of(given):
    tables = json.dumps([given[name] for name in ("gamma", "start", "world", "ended")], sort_keys=True)
    return hashlib.sha256(tables.encode()).hexdigest()[:16]


if __name__ == "__main__":
    for path in sys.argv[1:] or sys.exit(__doc__):
        try:
            with (gzip.open if path.endswith(".gz") else open)(path, "rb") as file:
                need(len(text := file.read(MOST_BYTES + 1)) <= MOST_BYTES, f"more than {MOST_BYTES:,} bytes")
            (best, worth), given = check(parsed(text)), json.loads(text)
            need(given["digest"] == digest_of(given), "digest: not that of its rows")
            least = outwards(worth, -math.inf)
            most = outwards(best - Fraction(least), math.inf)
        except Exception as error:  # whatever is wrong with a file, it proves nothing
            sys.exit(f"{path}: DOES NOT HOLD: {error or type(error).__name__}")
        print(f"{path}: holds. The policy earns at least {least}, and no policy earns {most} more than that.")
        size, scope = f"{len(given['world']):,} states", ascii(given["scope"])
        print(f"  Rows {digest_of(given)}, {size}, known like this: {scope}")
