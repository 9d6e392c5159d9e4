// Q-learning, SARSA and expected SARSA, step by step as gridworld/agents/tabular; and value and policy iteration.

import { argmax, backup, evaluate, floats, oneHot } from "./solver.js";

/** pi(a | s) (A,) of a row of Q: with probability epsilon any action, else one of the best. */
function rowPolicy(row, epsilon) {
  let best = -Infinity, many = 0;
  for (const x of row) x > best ? ((best = x), (many = 1)) : (many += x === best);
  return row.map(x => epsilon / row.length + (x === best ? (1 - epsilon) / many : 0));
}

/** The same of a whole table (S, A). */
export function epsilonGreedy(world, q, epsilon) {
  const policy = floats(q.length), { A } = world;
  for (let at = 0; at < q.length; at += A) policy.set(rowPolicy(q.subarray(at, at + A), epsilon), at);
  return policy;
}

/** How many of `count` thresholds a draw from [0, 1) reaches: which outcome, or which start, it means. */
function drawn(draw, thresholds, from, count) {
  let found = 0;
  for (let i = 0; i < count; i++) if (draw >= thresholds[from + i]) found++;
  return found;
}

/** A start, from a draw where there are several. */
export function drawStart(world, random) {
  const { starts, start } = world;
  if (starts.length === 1) return starts[0];
  const draw = random();
  if (starts.every(s => start[s] === start[starts[0]])) return starts[Math.floor(draw * starts.length)];
  let sum = 0;
  return starts.find(s => (sum += start[s]) > draw) ?? starts[starts.length - 1];
}

/** The outcome's place in the tables, from a draw where there are several. */
export function drawOutcome(world, state, action, random) {
  const { A, K, thresholds } = world, pair = state * A + action;
  return pair * K + (K > 1 ? drawn(random(), thresholds, pair * (K - 1), K - 1) : 0);
}

/** Temporal-difference control with a table (Sutton and Barto, 2nd ed., sections 6.4 to 6.6). */
export class Learner {
  /**
   * `kind`: q_learning, sarsa or expected_sarsa. `settings`, which may change meanwhile: gamma, epsilon, rate, power
   * (the step size is rate times visits ** -power) and initial, the value of all actions at first. `random` has
   * `world` and `agent`, which draw from [0, 1).
   */
  constructor(world, kind, settings, random) {
    Object.assign(this, { world, kind, settings, random, steps: 0, episodes: 0, elapsed: 0 });
    this.q = floats(world.n * world.A, settings.initial);
    world.terminal.forEach((is, s) => is && this.q.fill(0, s * world.A, (s + 1) * world.A));
    this.visits = new Int32Array(this.q.length);
    this.state = drawStart(world, random.world);
    this.action = this.act(this.state);
  }

  /** Go on in a world that was changed meanwhile, with what it has learnt. */
  adopt(world) {
    this.world = world;
    world.terminal.forEach((is, s) => is && this.row(s).fill(0));
    if (!world.absorbing[this.state] && world.map?.tiles[this.state] !== "C") return;
    Object.assign(this, { state: drawStart(world, this.random.world), elapsed: 0 });
    this.action = this.act(this.state);
  }

  row(state) {
    return this.q.subarray(state * this.world.A, (state + 1) * this.world.A);
  }

  act(state) {
    const draw = this.random.agent(), policy = rowPolicy(this.row(state), this.settings.epsilon);
    let sum = 0, action = 0;
    for (let a = 0; a < policy.length - 1; a++) if (draw >= (sum += policy[a])) action++;
    return action;
  }

  step() {
    const { world, settings, kind, q, visits, random } = this, pair = this.state * world.A + this.action;
    const at = drawOutcome(world, this.state, this.action, random.world), reached = world.next[at];
    const reward = world.reward[at], isOver = world.terminal[reached] || ++this.elapsed >= world.limit;
    const state = isOver ? drawStart(world, random.world) : reached;
    const row = this.row(reached);
    let ahead, action;
    if (kind === "sarsa") ahead = row[(action = this.act(reached))]; // drawn before the update, as in the book
    else if (kind === "q_learning") ahead = Math.max(...row);
    else ahead = rowPolicy(row, settings.epsilon).reduce((sum, p, a) => sum + p * row[a], 0);
    q[pair] += settings.rate * ++visits[pair] ** -settings.power * (reward + settings.gamma * ahead - q[pair]);
    this.steps++;
    if (isOver) Object.assign(this, { elapsed: 0, episodes: this.episodes + 1 });
    this.state = state;
    this.action = kind === "sarsa" && !isOver ? action : this.act(state);
  }
}

/** Value iteration, a sweep over all states a step, from V = 0. */
export class ValueIteration {
  constructor(world, settings) {
    Object.assign(this, { world, settings, steps: 0, v: floats(world.n), q: floats(world.n * world.A), done: false });
  }

  step() {
    const { world, v } = this, { A } = world;
    this.q = backup(world, v, this.settings.gamma);
    this.v = v.map((_, s) => (world.absorbing[s] ? 0 : Math.max(...this.q.subarray(s * A, (s + 1) * A))));
    this.change = this.v.reduce((most, x, s) => Math.max(most, Math.abs(x - v[s])), 0);
    this.done = this.change < 1e-12;
    this.steps++;
  }
}

/** Policy iteration: each step evaluates the policy exactly, and then takes the best action of every state. */
export class PolicyIteration {
  constructor(world, settings) {
    Object.assign(this, { world, settings, steps: 0, greedy: new Int32Array(world.n), done: false });
    this.evaluate();
  }

  evaluate() {
    const { v, scale } = evaluate(this.world, oneHot(this.world, this.greedy), this.settings.gamma);
    Object.assign(this, { v, scale, q: backup(this.world, v, this.settings.gamma) });
  }

  step() {
    const { A } = this.world, best = argmax(this.world, this.q), before = this.greedy;
    this.greedy = before.map((action, s) => {
      const gain = this.q[s * A + best[s]] - this.q[s * A + action];
      return gain > 1e-11 * (1e-200 + Math.abs(this.scale[s])) ? best[s] : action;
    });
    this.change = before.filter((action, s) => action !== this.greedy[s]).length;
    this.done = this.change === 0;
    this.steps++;
    this.evaluate();
  }
}
