// The page's state, and what is shown of it: numbers, map, curve, one cell in detail, and all of it as text.

import { argmax, atStart, backup, oneHot, outcome, score, split } from "./solver.js";
import { epsilonGreedy, Learner } from "./learners.js";
import { drawBoard, drawCurve, gradient, precise, short } from "./view.js";
import { cellName, command, mapText, SETTINGS } from "./world.js";

export const $ = id => document.getElementById(id);
export const data = JSON.parse($("data").textContent), { shipped, run } = data, isMap = !data.tables;
export const isEmbedded = parent !== self; // in a page of the documentation, or in a notebook
export const LEARNERS = { q_learning: "Q-learning", sarsa: "SARSA", expected_sarsa: "Expected SARSA" };
const PLANNERS = { optimum: "Optimum", value_iteration: "Value iteration", policy_iteration: "Policy iteration" };
export const MODES = { ...(run && { run: "Run" }), ...PLANNERS, ...LEARNERS };
export const SHOWS = { value: "values", q: "Q and Q*", error: "error of Q", visits: "visits", cost: "regret by cell" };
const KINDS = { "#": "wall", ".": "floor", S: "start", G: "goal", T: "trap", C: "cliff" };
export const TOOLS = { look: "Look", "#": "Wall", ".": "Floor", S: "Start", G: "Goal", T: "Trap", C: "Cliff" };
export const FIELDS = [ // key, label, the slider's least, most and step
  ["slip", "slip", 0, 1, 0.01],
  ["step_reward", "step reward", -1, 0.1, 0.01],
  ["gamma", "discount γ", 0, 1, 0.01],
  ["goal_reward", "goal reward", -1, 10, 0.1],
  ["trap_reward", "trap reward", -10, 0, 0.1],
  ["max_episode_steps", "step limit", 1, 500, 1],
];
export const HYPER = [
  ["epsilon", "exploration ε", 0, 1, 0.01],
  ["rate", "learning rate α", 0.01, 1, 0.01],
  ["power", "decay of α", 0, 1, 0.05],
  ["initial", "initial Q", -2, 2, 0.1],
];
export const app = {
  ...{ map: null, settings: { ...SETTINGS }, world: null, solution: null, problem: "", undo: [] },
  ...{ mode: run ? "run" : isEmbedded ? "q_learning" : "optimum", tool: "look", show: "value", selected: -1, hovered: -1 },
  ...{ hyper: { epsilon: 0.1, rate: 0.5, power: 0, initial: 1 }, process: null, moment: 0, curve: [], old: [] },
  ...{ playing: false, following: false, credit: 0, episode: null, scored: null, slow: 0 },
};

export function h(tag, properties, ...children) {
  const { role, ...rest } = properties ?? {}, element = Object.assign(document.createElement(tag), rest);
  if (role) element.setAttribute("role", role);
  element.append(...children);
  return element;
}

function row(tag, cells, rest) {
  return h("tr", rest, ...cells.map(each => (each instanceof Node ? each : h(tag, null, each))));
}

export function say(sentence) {
  $("message").textContent = sentence;
  $("message").hidden = !sentence;
}

/** Whether the world is still the one that the run was trained in. */
export function fitsRun() {
  return run && app.world && (!isMap || app.link === app.runLink) && app.settings.gamma === run.gamma;
}

/** Steps a second. */
export function rate() {
  const share = $("speed").value / 100;
  return app.process instanceof Learner ? 2 * 10 ** (5 * share) : 10 ** (2 * share);
}

/** Show everything again, `all` of it or what does not take long. */
export function refresh(all = !app.playing) {
  say(app.problem);
  if (app.world) rescore();
  if (isMap) drawMap();
  if (app.world) showScore(all), showCurve();
  else for (const id of ["regret", "value", "optimum", "verdict"]) $(id).textContent = id === "verdict" ? "" : "–";
  if (all) showControls(), showTexts();
  showCell();
}

// ---- what is watched ------------------------------------------------------------------------------------

/** Its values, Q, greedy actions and visits. */
function watched() {
  const { world, solution, mode, process } = app, { A } = world;
  if (mode === "optimum") return { ...solution, greedy: argmax(world, Float64Array.from(solution.optimal)) };
  if (mode === "run") {
    const q = app.moment === run.steps.length - 1 && run.q;
    const v = Float64Array.from(run.values[app.moment], (x, s) => (world.terminal[s] ? 0 : x));
    const visits = run.visits && Int32Array.from(run.visits), greedy = Int32Array.from(run.greedy[app.moment]);
    return { v, greedy, visits, q: q ? Float64Array.from(q) : backup(world, v, run.agent_gamma), isBackup: !q };
  }
  const { q, visits } = process, greedy = process.greedy ?? argmax(world, q);
  return { v: process.v ?? Float64Array.from(greedy, (a, s) => q[s * A + a]), q, greedy, visits };
}

/** Score it, unless its greedy policy is the one that was scored last. */
function rescore() {
  const { world, solution, scored } = app, now = (app.now = watched()), greedy = now.greedy.slice();
  if (scored?.solution === solution && scored.greedy.every((a, s) => a === greedy[s])) return;
  const policy = oneHot(world, greedy);
  app.scored = { solution, greedy, policy, ...score(world, solution, policy), path: pathOf(greedy) };
}

/** Where the greedy policy leads from the first start, if nothing slips. */
function pathOf(greedy) {
  const { world } = app, path = [world.starts[0]];
  for (let s = path[0]; !world.absorbing[s] && path.indexOf(s) === path.length - 1; )
    path.push((s = world.next[(s * world.A + greedy[s]) * world.K]));
  return path;
}

const isWrong = s => {
  const { world, map, solution, now } = app;
  return !world.absorbing[s] && map?.tiles[s] !== "C" && !solution.optimal[s * world.A + now.greedy[s]];
};

/** Where the regret of the greedy policy comes from, without what is rounding. */
function regrets() {
  const { scored, world, solution } = app;
  if (!scored.parts) {
    scored.parts = split(world, solution, scored.policy);
    const least = 1e-12 * atStart(world, solution.scale);
    scored.parts.cost = scored.parts.cost.map(x => (Math.abs(x) > least ? x : 0));
  }
  return scored.parts;
}

/** The state in which the agent is drawn; -1: none. */
export function agent() {
  if (app.episode) return app.episode.steps[app.episode.at].state;
  const isSeen = app.process instanceof Learner && app.process.steps && (!app.playing || rate() < 3000);
  return isSeen ? app.process.state : -1;
}

// ---- the map, the score, the curve ----------------------------------------------------------------------

/** The scale of what is shown: its palette, its ends, and where on it a state, or a state and action, is. */
function scale() {
  const { world, solution, now, show } = app, { A } = world;
  const playing = [...world.absorbing.keys()].filter(s => !world.absorbing[s]);
  const ends = (numbers, least = Infinity, most = -Infinity) => {
    for (const x of numbers) if (Number.isFinite(x)) (least = Math.min(least, x)), (most = Math.max(most, x));
    return least <= most ? [least, most] : [0, 1];
  };
  const linear = (palette, [low, high], of) => ({
    ...{ palette, low: short(low), high: short(high), number: s => short(of(s)) },
    of: at => (of(at) - low) / (high - low || 1),
  });
  if (show === "visits" && now.visits) {
    const total = s => now.visits.subarray(s * A, (s + 1) * A).reduce((a, b) => a + b);
    const most = ends(playing.map(total), 0, 1)[1], of = s => Math.log1p(total(s)) / Math.log1p(most);
    const high = `${many(most)} visits, logarithmic`;
    return { palette: "viridis", low: "0", high, of, number: s => many(total(s)) };
  }
  if (show === "cost") return linear("oranges", ends(regrets().cost, 0, 1e-9), s => regrets().cost[s]);
  if (show === "value" || show === "visits")
    return linear("viridis", ends(playing.flatMap(s => [solution.v[s], now.v[s]])), s => now.v[s]);
  const pairs = playing.flatMap(s => world.actions.map((_, a) => s * A + a));
  const error = at => Math.abs(now.q[at] - solution.q[at]) || 0;
  if (show === "error")
    return { ...linear("oranges", ends(pairs.map(error), 0, 1e-9), error), texts: at => [short(error(at))] };
  const range = ends(pairs.map(at => solution.q[at]));
  return { ...linear("viridis", range, at => now.q[at]), texts: at => [short(now.q[at]), short(solution.q[at])] };
}

/** A count in few signs. */
function many(n) {
  return n < 1e3 ? `${n}` : n < 1e6 ? `${(n / 1e3).toFixed(n < 1e4 ? 1 : 0)}k` : `${(n / 1e6).toFixed(1)}M`;
}

export function drawMap() {
  const { map, world, solution, now, scored, mode } = app, board = $("board");
  const most = isEmbedded ? 380 : Math.max(260, Math.min(window.innerHeight - 230, 760));
  const width = Math.min($("modes").clientWidth, 118 * map.cols, (most / map.rows) * map.cols);
  Object.assign(board.style, { width: `${width}px`, height: `${(width / map.cols) * map.rows}px` });
  const nothing = { palette: "viridis", of: () => null, number: () => "" }, shown = world ? scale() : nothing;
  const isShown = (s, a) => (mode === "optimum" ? solution.optimal[s * 4 + a] : a === now.greedy[s]);
  drawBoard($("canvas"), {
    map, fill: shown.texts ? nothing : shown, quarter: shown.texts && shown, number: shown.number,
    arrows: s => (!world || world.absorbing[s] ? [] : [0, 1, 2, 3].filter(a => isShown(s, a))),
    wrong: s => world && isWrong(s), path: world ? scored.path : [], agent: world ? agent() : -1,
    selected: app.hovered,
  });
  for (const end of ["low", "high"]) $(end).textContent = shown[end] ?? "";
  $("scale").style.background = gradient(shown.palette);
}

function showScore(all) {
  const { world, solution, scored, settings, mode, process } = app, { certified, policy } = scored;
  const percent = x => `${(100 * x).toFixed(x > 0.9995 && x < 1 ? 2 : 1).replace(/\.0+$/, "")} %`;
  $("regret").textContent = certified ? "0" : precise(scored.regret);
  $("regret").className = certified ? "good" : "bad";
  $("value").textContent = precise(scored.value);
  $("optimum").textContent = precise(atStart(world, solution.v));
  if (!all) return;
  const limit = Math.min(world.limit, 10000), { goal, trap, length } = outcome(world, policy, limit);
  const count = number => number.toLocaleString("en"), sentences = [];
  if (mode === "run") sentences.push(`After ${count(run.steps[app.moment])} steps.`, ...run.damage.map(each => `Missing: ${each}.`));
  if (process instanceof Learner) sentences.push(`${count(process.steps)} steps, ${count(process.episodes)} episodes.`);
  else if (mode === "value_iteration" && process.steps)
    sentences.push(`Sweep ${process.steps}: largest change ${short(process.change)}.`);
  else if (process?.steps) sentences.push(`Policy ${process.steps + 1}: ${process.change} actions changed.`);
  sentences.push(certified ? "Certified optimal: no policy is better from the start." : "Not optimal.");
  const ends = `goal ${percent(goal)}, trap ${percent(trap)}, ${Number(length.toFixed(1))} steps`;
  sentences.push(`Within ${count(limit)} steps: ${ends}.`);
  $("verdict").setAttribute("aria-live", app.playing ? "off" : "polite");
  $("verdict").textContent = sentences.join(" ");
  $("subtitle").textContent = mode === "run" ? run.title : isMap ? "" : `${data.title}, γ ${settings.gamma}`;
}

function showCurve() {
  const { process, mode, scored, world, solution } = app, isRun = mode === "run", canvas = $("curve");
  const last = app.curve.length ? app.curve[app.curve.length - 1][0] : -1;
  if (process && process.steps > last && process.steps - last >= last / 300) {
    const started = performance.now(), point = [process.steps, scored.certified ? 0 : scored.regret];
    if (process instanceof Learner && app.slow < 12) {
      point.push(score(world, solution, epsilonGreedy(world, process.q, process.settings.epsilon)).regret);
      app.slow = performance.now() - started;
    } else app.slow *= 0.8; // tried again later
    app.curve.push(point);
    if (app.curve.length > 600) app.curve = app.curve.filter((_, i) => i % 2 === 0);
  }
  canvas.hidden = mode === "optimum";
  if (canvas.hidden) return;
  const points = isRun ? run.steps.map((x, i) => [x, run.regrets[i] ?? Infinity]) : app.curve;
  const lines = app.old.map((line, i) => ({ ...line, colour: i ? "goal" : "good" }));
  lines.push({ points, colour: "accent", label: LEARNERS[mode] ?? "regret" });
  const exploring = points.filter(point => Number.isFinite(point[2])).map(([x, , y]) => [x, y]);
  if (exploring.length) lines.push({ points: exploring, colour: "muted", dash: [4, 3], label: "with its ε" });
  const unit = { value_iteration: "sweeps", policy_iteration: "policies" }[mode] ?? "steps";
  drawCurve(canvas, lines, unit, isRun && points[app.moment]);
  canvas.setAttribute("aria-label", `Regret of the greedy policy over ${unit}, now ${$("regret").textContent}`);
}

// ---- the controls ---------------------------------------------------------------------------------------

export function showControls() {
  const { mode, settings, world, map } = app;
  for (const [id, current] of [["modes", mode], ["tools", app.tool]])
    for (const button of $(id).querySelectorAll("[role=radio]")) {
      button.setAttribute("aria-checked", button.value === current);
      button.tabIndex = button.value === current ? 0 : -1;
      if (button.value === "run") button.disabled = !fitsRun();
    }
  $("play").textContent = app.playing ? "Pause" : "Play";
  for (const id of ["play", "step", "reset", "speed-label"])
    Object.assign($(id), { hidden: mode === "optimum", disabled: !world });
  $("moment-label").hidden = mode !== "run";
  if (run) Object.assign($("moment"), { max: run.steps.length - 1, value: app.moment });
  $("learner").hidden = !(mode in LEARNERS);
  for (const [key] of [...FIELDS, ...HYPER]) {
    const value = settings[key] ?? app.hyper[key];
    for (const id of [key, `${key}-slider`]) if (document.activeElement !== $(id)) $(id).value = value;
  }
  for (const option of $("show").options) option.disabled = option.value === "visits" && !app.now?.visits;
  for (const id of ["follow", "back", "forward"]) $(id).disabled = !world;
  $("undo").disabled = !app.undo.length;
  $("follow").textContent = app.following ? "Stop" : "Follow the greedy policy";
  const { steps, at } = app.episode ?? {};
  const where = steps && `step ${at} of ${steps.length - 1}: ${steps[at].text}; ${world.name(steps[at].state)}`;
  $("episode").textContent = where ?? "";
  if (!map) return;
  Object.assign($("rows"), { value: map.rows }), Object.assign($("cols"), { value: map.cols });
  $("maps").value = Object.keys(shipped).find(name => shipped[name].text === mapText(map)) ?? "";
  $("command").textContent = world ? commandLine() : "";
  for (const id of ["copy-command", "download"]) $(id).disabled = !world;
  $("grid").classList.toggle("drawing", app.tool !== "look");
}

export function commandLine() {
  const others = { run: run?.agent, value_iteration: "value_iteration", policy_iteration: "value_iteration" };
  const agent = app.mode in LEARNERS ? app.mode : others[app.mode] ?? "q_learning";
  return command(app.map, app.settings, shipped, /^\w+$/.test(agent) ? agent : "q_learning");
}

// ---- text: labels of the cells, the table of states, and one state in detail ----------------------------

function kind(s) {
  const { map, world } = app;
  return map ? KINDS[map.tiles[s]] : world.goal[s] ? "goal" : world.terminal[s] ? "end" : "";
}

function describe(s) {
  const { map, world, solution, now } = app;
  if (!world || world.absorbing[s] || map?.tiles[s] === "C") return kind(s);
  const best = world.actions.filter((_, a) => solution.optimal[s * world.A + a]).join(" or ");
  const taken = `${world.actions[now.greedy[s]]}${isWrong(s) ? ", not optimal" : ""}`;
  const shown = app.mode === "optimum" ? "" : `, shown ${short(now.v[s])}, takes ${taken}`;
  return `${kind(s)}, value ${short(solution.v[s])}, best ${best}${shown}`;
}

function showTexts() {
  const { world, solution, now, map } = app, table = $("states");
  if (isMap) {
    const cells = $("grid").querySelectorAll("[role=gridcell]");
    return cells.forEach((cell, s) => cell.setAttribute("aria-label", `${cellName(map, s)}: ${describe(s)}`));
  }
  if (!world) return table.querySelector("tbody").replaceChildren();
  const { cost } = regrets(), { A, absorbing, actions } = world;
  const rows = Array.from({ length: world.n }, (_, s) => {
    const best = actions.filter((_, a) => solution.optimal[s * A + a]).join(", "), takes = actions[now.greedy[s]];
    const greedy = h("td", { className: isWrong(s) ? "bad" : "" }, absorbing[s] ? "" : takes);
    const numbers = [solution.v[s], now.v[s], cost[s]].map(short), onclick = () => select(s);
    const rest = { className: s === app.selected ? "is" : "", tabIndex: 0, onclick };
    rest.onkeydown = event => event.key === "Enter" && select(s);
    return row("td", [world.name(s), absorbing[s] ? kind(s) : best, greedy, ...numbers], rest);
  });
  table.querySelector("thead").replaceChildren(row("th", ["state", "optimal", "greedy", "V*", "V", "regret"]));
  table.querySelector("tbody").replaceChildren(...rows);
}

export function select(state) {
  app.selected = state;
  refresh();
}

/** What an action leads to: each state once, with its probability, reward and value. */
function leads(pair) {
  const { world, solution } = app, { A, K, next, prob, reward } = world, s = Math.floor(pair / A), ways = new Map();
  for (let at = pair * K; at < (pair + 1) * K; at++) {
    const key = `${next[at]} ${reward[at]}`, way = ways.get(key) ?? { to: next[at], paid: reward[at], p: 0 };
    if (prob[at] > 0) ways.set(key, { ...way, p: way.p + prob[at] });
  }
  return Array.from(ways.values(), ({ to, paid, p }) => {
    const after = world.terminal[to] ? "ends" : `V* ${short(solution.v[to])}`;
    const name = to === s ? "stays" : `to ${world.name(to)}`;
    return `${Number((100 * p).toFixed(1))} % ${name} (${paid ? `reward ${short(paid)}` : "no reward"}, ${after})`;
  }).join("; ");
}

export function showCell() {
  const s = app.hovered >= 0 ? app.hovered : app.selected, { world, solution, now, map } = app, box = $("cell");
  const hint = "Point at a cell, tap it, or move to it with the arrow keys.";
  if (!world || s < 0) return box.replaceChildren(h("p", null, hint));
  const head = h("p", null, h("b", null, world.name(s)), kind(s) && `, ${kind(s)}`);
  if (world.absorbing[s] || map?.tiles[s] === "C") return box.replaceChildren(head);
  const { visits, lost, cost } = regrets(), pairs = world.actions.map((_, a) => s * world.A + a);
  const nothing = visits[s] > 0 ? "Nothing is lost here." : "The greedy policy does not come here from the start.";
  const parts = `${short(visits[s])} discounted visits, each loses ${short(lost[s])}`;
  const why = cost[s] > 0 ? `Costs ${short(cost[s])} of the regret: ${parts}.` : nothing;
  const numbers = (at, a) => {
    const marks = `${a === now.greedy[s] ? " ●" : ""}${solution.optimal[at] ? " ✓" : ""}`;
    const count = now.visits ? now.visits[at].toLocaleString("en") : "–";
    return row("td", [world.actions[a] + marks, short(now.q[at]), short(solution.q[at]), count]);
  };
  const titles = row("th", ["action", now.isBackup ? "Q (a backup of V)" : "Q", "Q*", "visits"]);
  box.replaceChildren(
    head,
    h("p", null, `V* ${short(solution.v[s])}, shown ${short(now.v[s])}. ${why}`),
    h("table", null, h("thead", null, titles), h("tbody", null, ...pairs.map(numbers))),
    h("ul", null, ...pairs.map((at, a) => h("li", null, `${world.actions[a]}: ${leads(at)}`))),
    h("p", null, "● greedy, ✓ optimal"),
  );
}
