// The exact value of a policy, the optimum with all optimal actions, and where regret comes from; the same
// definitions, tolerances and order of work as gridworld/world/{chain,solver}.py and gridworld/diagnosis/evidence.py.

import { Mistake } from "./world.js";

const ORDINARY_GAMMA = 0.9999, TIE = 1e-9, IMPROVEMENT = 1e-11, PATIENT = 100, NOTHING = 1e-290, KEPT = 1e-10;
const SAME_SLOPE = 1e-11, VISIBLE_IN_LARGE = 1e-13, CERTIFIED = 1e-6;
const visible = world => (world.n <= 512 ? 8e-15 : VISIBLE_IN_LARGE);

export const floats = (size, value) => new Float64Array(size).fill(value ?? 0);
export const oneHot = (world, actions) => {
  const policy = floats(world.n * world.A);
  actions.forEach((action, s) => (policy[s * world.A + action] = 1));
  return policy;
};

/** Q(s, a) = sum_k p_k [ r_k + gamma v(next_k) ], flat (S, A). */
export function backup(world, v, gamma, magnitude = false) {
  const { K, next, prob, reward } = world, q = floats(world.n * world.A);
  for (let pair = 0, at = 0; pair < q.length; pair++)
    for (let k = 0; k < K; k++, at++)
      if (prob[at] > 0) q[pair] += prob[at] * ((magnitude ? Math.abs(reward[at]) : reward[at]) + gamma * v[next[at]]);
  return q;
}

/** (S,), the first of the best actions. */
export function argmax(world, q) {
  const best = new Int32Array(world.n);
  for (let s = 0, at = 0; s < world.n; s++)
    for (let a = 0; a < world.A; a++, at++) if (q[at] > q[s * world.A + best[s]]) best[s] = a;
  return best;
}

/** (S,), the fewest steps to `targets` (S,) by the outcomes `taken` (S, A, K); -1: there is no way. */
function stepsTo(world, taken, targets) {
  const steps = new Int32Array(world.n).fill(-1), waiting = [], { first, into } = world.predecessors;
  targets.forEach((is, s) => is && (steps[s] = 0, waiting.push(s)));
  for (const to of waiting)
    for (let at = first[to]; at < first[to + 1]; at++) {
      const s = Math.floor(into[at] / (world.A * world.K));
      if (steps[s] < 0 && taken[into[at]]) steps[s] = steps[to] + 1, waiting.push(s);
    }
  return steps;
}

/**
 * A system x = right + W x with W >= 0 whose rows sum up to 1 - leak, solved by elimination without subtractions
 * (`Elimination` in world/chain.py), row by row between each row's first and last entry.
 */
class Elimination {
  constructor(size, entries, leak) {
    const low = Int32Array.from({ length: size }, (_, i) => i), high = low.slice();
    for (const [i, j] of entries) (low[i] = Math.min(low[i], j)), (high[i] = Math.max(high[i], j));
    for (let i = 0; i < size; i++) for (let k = low[i]; k < i; k++) high[i] = Math.max(high[i], high[k]);
    const rows = Array.from(low, (from, i) => floats(high[i] - from + 1));
    for (const [i, j, weight] of entries) if (i !== j) rows[i][j - low[i]] += weight;
    const pivots = floats(size);
    for (let i = 0; i < size; i++) {
      const row = rows[i], from = low[i];
      for (let k = from; k < i; k++) {
        const factor = row[k - from], other = rows[k], shift = low[k];
        if (factor === 0) continue;
        for (let j = k + 1; j <= high[k]; j++) row[j - from] += factor * other[j - shift];
        leak[i] += factor * leak[k];
      }
      pivots[i] = leak[i];
      for (let j = i + 1; j <= high[i]; j++) pivots[i] += row[j - from];
      for (let j = i + 1; j <= high[i]; j++) row[j - from] /= pivots[i];
      leak[i] /= pivots[i];
    }
    Object.assign(this, { size, low, high, rows, pivots });
  }

  solve(x) {
    const { size, low, high, rows, pivots } = this;
    for (let i = 0; i < size; i++) {
      for (let k = low[i]; k < i; k++) x[i] += rows[i][k - low[i]] * x[k];
      x[i] /= pivots[i];
    }
    for (let i = size - 1; i >= 0; i--) for (let j = i + 1; j <= high[i]; j++) x[i] += rows[i][j - low[i]] * x[j];
    return x;
  }

  solveTransposed(x) {
    const { size, low, high, rows, pivots } = this;
    for (let i = 0; i < size; i++) for (let j = i + 1; j <= high[i]; j++) x[j] += rows[i][j - low[i]] * x[i];
    for (let i = size - 1; i >= 0; i--) {
      x[i] /= pivots[i];
      for (let k = low[i]; k < i; k++) x[k] += rows[i][k - low[i]] * x[i];
    }
    return x;
  }
}

/** States under one policy (S, A). */
class Chain {
  constructor(world, policy) {
    const { n, A, K, prob } = world;
    this.world = world;
    this.weight = Float64Array.from(prob, (p, at) => policy[Math.floor(at / K)] * p);
    this.taken = Uint8Array.from(this.weight, weight => weight > 0);
    this.perState = A * K;
    this.n = n;
  }

  /** sum over a state's outcomes of weight times `of(outcome)`. */
  expected(of) {
    const sums = floats(this.n), { weight, perState } = this;
    for (let at = 0; at < weight.length; at++)
      if (weight[at] > 0) sums[Math.floor(at / perState)] += weight[at] * of(at);
    return sums;
  }

  /** The system of the states of `playing`. */
  system(gamma, playing) {
    const states = [...playing.keys()].filter(s => playing[s]), place = new Int32Array(this.n).fill(-1), entries = [];
    states.forEach((s, i) => (place[s] = i));
    const leak = floats(states.length, 1 - gamma), { next } = this.world;
    for (const [i, s] of states.entries())
      for (let at = s * this.perState; at < (s + 1) * this.perState; at++) {
        if (!(this.weight[at] > 0)) continue;
        if (place[next[at]] < 0) leak[i] += gamma * this.weight[at];
        else entries.push([i, place[next[at]], gamma * this.weight[at]]);
      }
    return { states, factors: new Elimination(states.length, entries, leak) };
  }

  /** x = right + gamma P x for each of `rights`; with gamma = 1 infinite where x does not stop growing. */
  sums(rights, gamma) {
    const { world } = this, found = rights.map(() => floats(this.n));
    const playing = world.absorbing.map(is => !is);
    if (gamma === 1) {
      const recurrent = this.recurrent();
      rights.forEach((right, column) => {
        const paying = new Set([...recurrent.keys()].filter(s => recurrent[s] && right[s] > 0).map(s => recurrent[s]));
        if (!paying.size) return;
        const steps = stepsTo(world, this.taken, Uint8Array.from(recurrent, each => paying.has(each)));
        steps.forEach((each, s) => each >= 0 && (found[column][s] = Infinity));
      });
      playing.forEach((is, s) => {
        if (recurrent[s] || found.some(column => !Number.isFinite(column[s]))) playing[s] = 0;
      });
    }
    const { states, factors } = this.system(gamma, playing);
    rights.forEach((right, column) => {
      const x = factors.solve(Float64Array.from(states, s => right[s]));
      states.forEach((s, i) => (found[column][s] = x[i]));
    });
    return found;
  }

  /** (S,), a number from 1 on for each class of states that an episode never leaves, else 0. */
  recurrent() {
    const { world, n, taken, perState } = this, found = new Int32Array(n), ends = stepsTo(world, taken, world.terminal);
    const known = ends.map((steps, s) => steps >= 0 || world.absorbing[s]);
    for (let s = 0, classes = 0; s < n; s++) {
      if (known[s]) continue;
      const ahead = [s], seen = new Set(ahead), back = stepsTo(world, taken, ends.map((_, t) => t === s));
      for (const from of ahead)
        for (let at = from * perState; at < (from + 1) * perState; at++)
          if (taken[at] && !seen.has(world.next[at])) ahead.push(world.next[at]), seen.add(world.next[at]);
      if (ahead.every(t => back[t] >= 0)) classes++, ahead.forEach(t => ((known[t] = 1), (found[t] = classes)));
      else back.forEach((steps, t) => steps >= 0 && (known[t] = 1)); // who comes here is led astray as well
    }
    return found;
  }

  /** Value and its scale, the expected sum of |r|; with their slopes in gamma if asked for. */
  evaluation(gamma, withSlope = false) {
    const { reward, next } = this.world;
    const parts = ([gains, losses]) => [gains.map((x, s) => x - losses[s]), gains.map((x, s) => x + losses[s])];
    const paid = [1, -1].map(sign => this.expected(at => Math.max(sign * reward[at], 0)));
    const sums = this.sums(paid, gamma), [v, scale] = parts(sums);
    if (!withSlope) return { v, scale };
    const finite = sums.map(sum => sum.map(x => (Number.isFinite(x) ? x : 0)));
    const slopes = this.sums(finite.map(sum => this.expected(at => sum[next[at]])), gamma);
    slopes.forEach((slope, column) => sums[column].forEach((x, s) => Number.isFinite(x) || (slope[s] = Infinity)));
    const [slope, slopeScale] = parts(slopes);
    return { v, scale, slope, slopeScale };
  }
}

/** V of a policy (S, A), and its scale (S,). */
export const evaluate = (world, policy, gamma) => new Chain(world, policy).evaluation(gamma);

export const atStart = (world, values) => world.starts.reduce((sum, s) => sum + world.start[s] * values[s], 0);

/** The exact score of a policy (S, A) beside the optimum: value, regret, whether it is certified optimal. */
export function score(world, solution, policy) {
  const v = evaluate(world, policy, solution.gamma).v, value = atStart(world, v), best = atStart(world, solution.v);
  const regret = value === best ? 0 : best - value;
  return { v, value, regret, certified: regret <= CERTIFIED * atStart(world, solution.scale) };
}

/** What an episode of at most `limit` steps comes to: the probabilities of its ends, and its expected length. */
export function outcome(world, policy, limit) {
  const chain = new Chain(world, policy), { n, terminal, next } = world;
  const used = [...chain.taken.keys()].filter(at => chain.taken[at] && !terminal[Math.floor(at / chain.perState)]);
  const sums = (mass, tables) => tables.map(table => mass.reduce((sum, x, s) => sum + (table(s) ? x : 0), 0));
  let mass = Float64Array.from(world.start), steps = 0, length = 0, live = 1;
  const isLive = s => !terminal[s];
  while (steps++ < limit && (live = sums(mass, [isLive])[0]) > 1e-15) {
    length += live;
    const after = mass.map((x, s) => (terminal[s] ? x : 0));
    for (const at of used) after[next[at]] += mass[Math.floor(at / chain.perState)] * chain.weight[at];
    mass = after;
  }
  const isTrap = s => terminal[s] && !world.goal[s];
  const [goal, trap, timeout] = sums(mass, [s => world.goal[s], isTrap, isLive]).map(x => Math.min(x, 1));
  return { goal, trap, timeout, length: Math.min(length, limit) };
}

/** The regret of a policy (S, A) by state: discounted visits, what each loses, and their product. */
export function split(world, solution, policy) {
  const chain = new Chain(world, policy), { A } = world, { gamma, v, q } = solution;
  const ends = stepsTo(world, chain.taken, world.terminal);
  const stops = world.absorbing.map((is, s) => is || (gamma === 1 && ends[s] < 0));
  const { states, factors } = chain.system(gamma, stops.map(is => !is));
  const d = factors.solveTransposed(Float64Array.from(states, s => world.start[s]));
  const visits = world.start.map((x, s) => (stops[s] ? x : 0));
  states.forEach((s, i) => (visits[s] = d[i]));
  for (const s of states)
    for (let at = s * chain.perState; at < (s + 1) * chain.perState; at++)
      if (chain.taken[at] && stops[world.next[at]]) visits[world.next[at]] += gamma * chain.weight[at] * visits[s];
  const own = gamma === 1 ? chain.evaluation(gamma).v : v;
  const lost = v.map((best, s) => {
    if (stops[s]) return best - (world.absorbing[s] ? 0 : own[s]) || 0;
    let chosen = 0;
    for (let at = s * A; at < (s + 1) * A; at++) if (policy[at] > 0) chosen += policy[at] * q[at];
    return best - chosen || 0; // where V* is -inf, every action is as good
  });
  return { visits, lost, cost: visits.map((x, s) => (x > 0 ? x * lost[s] : 0)) };
}

/** The optimum: V*, Q*, which actions are optimal (S, A), and the scale (S,) that "relative" is relative to. */
export function solve(world, gamma) {
  const ordinary = Math.min(gamma, ORDINARY_GAMMA);
  let greedy = argmax(world, backup(world, swept(world, ordinary), ordinary));
  if (gamma <= ORDINARY_GAMMA) return discounted(world, gamma, greedy);
  if (gamma === 1) greedy = betterOrResting(world, greedy);
  const { found, optimal } = byValueAndSlope(world, gamma, greedy);
  return { gamma, v: found.v, q: backup(world, found.v, gamma), optimal, scale: found.scale };
}

/** Values good enough to begin with: sweeps over the states, forwards and backwards. */
function swept(world, gamma) {
  const { n, A, K, next, prob, reward, absorbing } = world, v = floats(n);
  for (let sweep = 0, changed = true; changed && sweep < 400; sweep++) {
    changed = false;
    for (let i = 0; i < n; i++) {
      const s = sweep % 2 ? n - 1 - i : i;
      if (absorbing[s]) continue;
      let best = -Infinity;
      for (let a = 0, at = s * A * K; a < A; a++) {
        let q = 0;
        for (let k = 0; k < K; k++, at++) q += prob[at] * (reward[at] + gamma * v[next[at]]);
        if (q > best) best = q;
      }
      if (Math.abs(best - v[s]) > NOTHING + 1e-3 * Math.abs(best)) changed = true;
      v[s] = best;
    }
  }
  return v;
}

function discounted(world, gamma, greedy) {
  const { n, A } = world, seen = new Set(), precision = Math.min(1, PATIENT * (1 - gamma));
  while (true) {
    const { v, scale } = evaluate(world, oneHot(world, greedy), gamma);
    const q = backup(world, v, gamma), sizes = backup(world, scale, gamma, true), best = argmax(world, q);
    seen.add(greedy.join());
    greedy = greedy.map((action, s) => {
      const one = s * A + best[s], other = s * A + action;
      const least = precision * IMPROVEMENT * Math.max(sizes[one], sizes[other]);
      return q[one] - q[other] > NOTHING + least ? best[s] : action;
    });
    if (!seen.has(greedy.join())) continue;
    const optimal = Uint8Array.from(q, (value, at) => {
      const top = Math.floor(at / A) * A + best[Math.floor(at / A)];
      return value >= q[top] - precision * TIE * Math.max(sizes[at], sizes[top]);
    });
    return { gamma, v, q, optimal, scale };
  }
}

/** Policy iteration for gamma near 1: the larger value first, of equal values the smaller slope. */
function byValueAndSlope(world, gamma, greedy) {
  const { A } = world, worse = new Uint8Array(world.n * A), seen = new Set();
  let found = new Chain(world, oneHot(world, greedy)).evaluation(gamma, true);
  while (true) {
    seen.add(greedy.join());
    const { optimal, improved } = bestActions(world, found, gamma, greedy, worse);
    if (seen.has(improved.join())) return { found, optimal };
    const then = new Chain(world, oneHot(world, improved)).evaluation(gamma, true);
    const kept = then.v.map((x, s) => x >= found.v[s] - KEPT * found.scale[s] ? 1 : 0);
    if (kept.every((is, s) => is || found.v[s] === -Infinity)) {
      greedy = improved;
      found = then;
      continue;
    }
    const changed = [...improved.keys()].filter(s => improved[s] !== greedy[s]), fallen = changed.filter(s => !kept[s]);
    for (const s of fallen.length ? fallen : changed) worse[s * A + improved[s]] = 1;
  }
}

function bestActions(world, found, gamma, greedy, worse) {
  const { n, A, next, reward } = world, lost = found.v.map(x => (Number.isFinite(x) ? 0 : 1)), size = visible(world);
  const ahead = [at => found.v[next[at]], at => found.scale[next[at]]];
  const delay = advantage(world, found.slope, found.slopeScale, gamma, ...ahead);
  let gain, better;
  for (const negligible of [0, size]) {
    gain = advantage(world, found.v, found.scale, gamma, at => reward[at], at => Math.abs(reward[at]), negligible);
    gain.gained.forEach((_, at) => worse[at] && (gain.gained[at] = -Infinity));
    better = gain.gained.map((x, at) => (x > gain.rounding[at] * size ? 1 : 0));
    if (better.some(is => is)) break;
  }
  const optimal = new Uint8Array(n * A), improved = greedy.slice(), isBetter = better.some(is => is);
  for (let s = 0; s < n; s++) {
    const here = s * A + greedy[s];
    let best = -1, soonest = s * A;
    for (let at = s * A; at < (s + 1) * A; at++) {
      const good = gain.gained[at] >= -gain.rounding[at] * size || at === here || lost[s];
      if (!good) delay.gained[at] = Infinity;
      optimal[at] = good && (delay.gained[at] <= delay.rounding[at] * SAME_SLOPE || lost[s]) ? 1 : 0;
      if (better[at] && (best < 0 || gain.gained[at] > gain.gained[best])) best = at;
      if (delay.gained[at] < delay.gained[soonest]) soonest = at;
    }
    if (isBetter && best >= 0) improved[s] = best - s * A;
    const isSooner = !lost[s] && delay.gained[soonest] < -delay.rounding[soonest] * SAME_SLOPE;
    if (!isBetter && isSooner) improved[s] = soonest - s * A;
  }
  return { optimal, improved };
}

/** sum_k p_k [ r_k + gamma x(next_k) - x(s) ] (S, A), and the size that its rounding is relative to. */
function advantage(world, x, scale, gamma, paid, paidScale, negligible = 0) {
  const { n, A, K, next, prob, absorbing } = world, gained = floats(n * A), rounding = floats(n * A);
  for (let pair = 0, at = 0; pair < n * A; pair++) {
    const s = Math.floor(pair / A);
    for (let k = 0; k < K; k++, at++) {
      if (!(prob[at] > 0)) continue;
      const to = next[at], moved = to === s ? 0 : 1;
      const change = paid(at) + gamma * (x[to] - x[s]) - (1 - gamma) * x[s];
      const size = paidScale(at) + moved * (scale[to] + scale[s]) + (1 - gamma) * scale[s];
      if (Math.abs(change) < negligible * size) continue;
      gained[pair] += prob[at] * change;
      rounding[pair] += prob[at] * size;
    }
    if (!Number.isFinite(rounding[pair])) (gained[pair] = -Infinity), (rounding[pair] = 0);
    if (absorbing[s]) gained[pair] = rounding[pair] = 0;
  }
  return { gained, rounding };
}

function betterOrResting(world, one) {
  const other = resting(world), [first, second] = [one, other].map(each => evaluate(world, oneHot(world, each), 1));
  return one.map((action, s) => {
    const isBetter = first.v[s] > second.v[s] + VISIBLE_IN_LARGE * (first.scale[s] + second.scale[s]);
    return isBetter || (second.v[s] === -Infinity && Number.isFinite(first.v[s])) ? action : other[s];
  });
}

/** A policy (S,) that surely comes to an end or to rest, wherever one can. */
function resting(world) {
  const { n, A, K, next, prob, reward, absorbing, terminal } = world;
  const possible = Uint8Array.from(prob, p => p > 0), playing = absorbing.map(is => (is ? 0 : 1));
  const some = (pair, test) => {
    for (let at = pair * K; at < (pair + 1) * K; at++) if (possible[at] && test(at)) return true;
    return false;
  };
  const pairs = test => Uint8Array.from({ length: n * A }, (_, pair) => (test(pair) ? 1 : 0));
  const goingOn = staying(world, some, playing, pairs(() => true));
  if (goingOn.some((is, pair) => is && some(pair, at => reward[at] > 0)))
    throw new Mistake("gamma=1: an episode that never ends collects rewards, so the return may be infinite; use a " +
      "gamma below 1, or step and trap rewards of at most 0");
  const rests = staying(world, some, playing, pairs(pair => !some(pair, at => reward[at] !== 0)));
  const rest = terminal.map((is, s) => (rests.subarray(s * A, (s + 1) * A).some(each => each) ? 1 : 0));
  let safe = new Uint8Array(n).fill(1), steps, ways;
  while (true) { // drop what can be led astray from every way there
    ways = Uint8Array.from(possible, (is, at) => is && !some(Math.floor(at / K), each => !safe[next[each]]));
    steps = stepsTo(world, ways, terminal.map((is, s) => is | rest[s]));
    if (steps.every((each, s) => (each >= 0 ? 1 : 0) === safe[s])) break;
    safe = Uint8Array.from(steps, each => each >= 0);
  }
  return Int32Array.from(rest, (is, s) => {
    for (let a = 0; a < A; a++) {
      const pair = s * A + a;
      if (is ? rests[pair] : some(pair, at => ways[at] && steps[next[at]] < steps[s])) return a;
    }
    return 0;
  });
}

/** (S, A), those of `actions` by which one can stay `within` some states for ever. */
function staying(world, some, within, actions) {
  while (true) {
    const keeps = pair => within[Math.floor(pair / world.A)] && !some(pair, at => !within[world.next[at]]);
    const keeping = actions.map((is, pair) => is && keeps(pair));
    const left = within.map((_, s) => (keeping.subarray(s * world.A, (s + 1) * world.A).some(each => each) ? 1 : 0));
    if (left.every((is, s) => is === within[s])) return keeping;
    within = left;
  }
}
