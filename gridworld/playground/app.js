// The page: its controls, what it shows, links and files, and the loop in which things learn.

import { argmax, atStart, backup, evaluate, oneHot, outcome, score, solve, split } from "./solver.js";
import { drawBoard, drawCurve, gradient, precise, short } from "./view.js";
import { drawOutcome, drawStart, epsilonGreedy, Learner, PolicyIteration, ValueIteration } from "./learners.js";
import { check, checked, cellName, command, compile, emptyMap, fromTables, link, mapText, Mistake, MOST_CELLS, MOST_SIDE, parse, readLink, SETTINGS } from "./world.js";

const $ = id => document.getElementById(id);
const data = JSON.parse($("data").textContent), { shipped, run } = data, isMap = !data.tables;
const LEARNERS = { q_learning: "Q-learning", sarsa: "SARSA", expected_sarsa: "Expected SARSA" };
const MODES = { ...(run ? { run: "Run" } : {}), optimum: "Optimum", value_iteration: "Value iteration", policy_iteration: "Policy iteration", ...LEARNERS };
const SHOWS = { value: "values", q: "Q and Q*", error: "error of Q", visits: "visits", cost: "regret by cell" };
const TOOLS = { look: "Look", "#": "Wall", ".": "Floor", S: "Start", G: "Goal", T: "Trap", C: "Cliff" };
const KINDS = { "#": "wall", ".": "floor", S: "start", G: "goal", T: "trap", C: "cliff" };
const FIELDS = [ // key, label, least and most of the slider, its step
  ["slip", "slip", 0, 1, 0.01], ["step_reward", "step reward", -1, 0.1, 0.01], ["gamma", "discount γ", 0, 1, 0.01],
  ["goal_reward", "goal reward", -1, 10, 0.1], ["trap_reward", "trap reward", -10, 0, 0.1], ["max_episode_steps", "step limit", 1, 500, 1],
];
const HYPER = [["epsilon", "exploration ε", 0, 1, 0.01], ["rate", "learning rate α", 0.01, 1, 0.01], ["power", "decay of α by visits", 0, 1, 0.05], ["initial", "first Q", -2, 2, 0.1]];
const app = {
  map: null, settings: { ...SETTINGS }, hyper: { epsilon: 0.1, rate: 0.5, power: 0, initial: 0 }, mode: run ? "run" : "optimum", tool: "look", show: "value",
  selected: -1, hovered: -1, playing: false, following: false, credit: 0, moment: 0, curve: [], old: [], undo: [], episode: null, problem: "", slow: 0,
};

function h(tag, properties, ...children) {
  const { role, ...rest } = properties ?? {}, element = Object.assign(document.createElement(tag), rest);
  if (role) element.setAttribute("role", role);
  element.append(...children);
  return element;
}

// ---- the world -------------------------------------------------------------------------------------------------

/** Take another map and other settings; raises nothing, a mistake is shown. */
function setWorld(map, settings, keep = false) {
  const before = app.world;
  Object.assign(app, { map, settings, problem: "", world: null, solution: null });
  try {
    app.world = isMap ? compile(map, settings) : fromTables(data.tables);
    app.solution = solve(app.world, settings.gamma);
  } catch (error) {
    if (!(error instanceof Mistake)) throw error;
    Object.assign(app, { problem: error.message, world: null, playing: false });
  }
  if (isMap) {
    app.link = link(map, settings, shipped);
    history.replaceState(null, "", `#${app.link}`);
    buildGrid();
  }
  app.old = [];
  if (app.mode === "run" && !fitsRun()) app.mode = "optimum";
  const learns = keep && app.world && app.process?.adopt && before?.n === app.world.n;
  if (learns) app.process.adopt(app.world), (app.process.settings = learnerSettings()), (app.episode = null);
  else restart();
  refresh();
}

const fitsRun = () => run && app.world && (!isMap || app.link === app.runLink) && app.settings.gamma === run.gamma;
const learnerSettings = () => ({ ...app.hyper, gamma: app.settings.gamma });

function restart() {
  const { mode, world } = app;
  if (app.process instanceof Learner && app.curve.length > 2 && mode !== app.process.kind)
    app.old = [...app.old, { label: LEARNERS[app.process.kind], points: app.curve.map(([x, y]) => [x, y]) }].slice(-2);
  Object.assign(app, { playing: false, following: false, episode: null, curve: [], credit: 0, process: null, scored: null });
  if (!world || mode === "optimum") return;
  if (mode === "run") app.moment = run.steps.length - 1;
  else if (mode in LEARNERS) app.process = new Learner(world, mode, learnerSettings(), { world: Math.random, agent: Math.random });
  else app.process = new (mode === "value_iteration" ? ValueIteration : PolicyIteration)(world, learnerSettings());
}

function edit(change) {
  app.undo = [...app.undo.slice(-99), { map: app.map, settings: app.settings }];
  change();
}

function paint(state, tile) {
  if (app.map.tiles[state] === tile) return;
  setWorld({ ...app.map, tiles: app.map.tiles.slice(0, state) + tile + app.map.tiles.slice(state + 1) }, app.settings, true);
}

function resize(rows, cols) {
  if (rows > MOST_SIDE || cols > MOST_SIDE || rows * cols > MOST_CELLS || rows * cols < 2 || !(rows >= 1 && cols >= 1)) return refresh();
  const old = app.map, map = emptyMap(rows, cols), kept = [...map.tiles].map((_, s) => {
    const row = Math.floor(s / cols), col = s % cols;
    return row < old.rows && col < old.cols ? old.tiles[row * old.cols + col] : ".";
  });
  if (!kept.includes("S")) kept[0] = "S";
  if (!kept.includes("G")) kept[rows * cols - 1] = "G";
  edit(() => setWorld({ ...map, tiles: kept.join("") }, app.settings));
}

function open(hash) {
  try {
    const { map, settings } = readLink(hash, shipped);
    setWorld(map, settings);
  } catch (error) {
    if (!(error instanceof Mistake)) throw error;
    if (!app.map) setWorld(...Object.values(readLink("", shipped)));
    say(error.message);
  }
}

async function loadFile(file) {
  try {
    if (file.size > 4 * MOST_CELLS) throw new Mistake("the file is too large for a map");
    const map = parse(await file.text());
    check(map, app.settings);
    edit(() => setWorld(map, app.settings));
  } catch (error) {
    say(`${file.name.slice(0, 80)}: ${error instanceof Mistake ? error.message : "cannot be read"}`);
  }
}

function say(sentence) {
  $("message").textContent = sentence;
  $("message").hidden = !sentence;
}

// ---- what is shown ---------------------------------------------------------------------------------------------

/** Values, Q, greedy actions and visits of what is watched. */
function watched() {
  const { world, solution, mode, process } = app, { A } = world;
  if (mode === "optimum") return { v: solution.v, q: solution.q, greedy: argmax(world, Float64Array.from(solution.optimal)), visits: null };
  if (mode === "run") {
    const isLast = app.moment === run.steps.length - 1, v = Float64Array.from(run.values[app.moment], (x, s) => (world.terminal[s] ? 0 : x));
    const q = isLast && run.q ? Float64Array.from(run.q) : backup(world, v, run.agent_gamma);
    return { v, q, greedy: Int32Array.from(run.greedy[app.moment]), visits: run.visits && Int32Array.from(run.visits), hasQ: isLast && run.q };
  }
  const q = process.q, greedy = process.greedy ?? argmax(world, q);
  return { v: process.v ?? Float64Array.from(greedy, (a, s) => q[s * A + a]), q, greedy, visits: process.visits ?? null };
}

/** Score what is watched, unless its greedy policy is the one that was scored last. */
function rescore() {
  const { world, solution } = app, now = watched(), scored = app.scored;
  app.now = now;
  if (scored?.solution === solution && scored.greedy.every((a, s) => a === now.greedy[s])) return;
  const policy = oneHot(world, now.greedy);
  app.scored = { solution, greedy: now.greedy.slice(), policy, ...score(world, solution, policy), path: pathOf(now.greedy) };
}

/** Where the greedy policy leads from the first start, if nothing slips. */
function pathOf(greedy) {
  const { world } = app, path = [world.starts[0]], seen = new Set(path);
  for (let s = path[0]; !world.absorbing[s];) {
    s = world.next[(s * world.A + greedy[s]) * world.K];
    path.push(s);
    if (seen.has(s)) break;
    seen.add(s);
  }
  return path;
}

const isWrong = s => !app.world.absorbing[s] && app.map?.tiles[s] !== "C" && !app.solution.optimal[s * app.world.A + app.now.greedy[s]];

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


/** The scale of what is shown: its palette, its ends, and where on it a state or a state and action is. */
function scale() {
  const { world, solution, now, show } = app, playing = [...world.absorbing.keys()].filter(s => !world.absorbing[s]);
  const ends = numbers => {
    const finite = numbers.filter(Number.isFinite);
    return finite.length ? [finite.reduce((a, b) => Math.min(a, b)), finite.reduce((a, b) => Math.max(a, b))] : [0, 1];
  };
  const linear = (palette, [low, high], of, number) => ({ palette, low: short(low), high: short(high), of: at => (of(at) - low) / (high - low || 1), number: number ?? (s => short(of(s))) });
  if (show === "visits" && now.visits) {
    const total = s => now.visits.subarray(s * world.A, (s + 1) * world.A).reduce((a, b) => a + b), most = Math.max(1, ends(playing.map(total))[1]);
    return { palette: "viridis", low: "0", high: `${most.toLocaleString("en")} visits (logarithmic)`, of: s => Math.log1p(total(s)) / Math.log1p(most), number: s => compact(total(s)) };
  }
  if (show === "cost") return linear("oranges", [0, ends(regrets().cost)[1] || 1], s => regrets().cost[s]);
  if (show === "error" || show === "q") {
    const of = show === "q" ? at => now.q[at] : at => Math.abs(now.q[at] - solution.q[at]) || 0;
    const pairs = playing.flatMap(s => Array.from({ length: world.A }, (_, a) => s * world.A + a));
    const [low, high] = ends(pairs.map(show === "q" ? at => solution.q[at] : of)), most = show === "q" ? high : high || 1;
    return { ...linear(show === "q" ? "viridis" : "oranges", [show === "q" ? low : 0, most], of), texts: at => (show === "q" ? [short(of(at)), short(solution.q[at])] : [short(of(at))]), byPair: true };
  }
  return linear("viridis", ends(playing.flatMap(s => [solution.v[s], now.v[s]])), s => now.v[s]);
}

const compact = count => (count < 1e3 ? String(count) : count < 1e6 ? `${(count / 1e3).toFixed(count < 1e4 ? 1 : 0)}k` : `${(count / 1e6).toFixed(1)}M`);

/** The state in which the agent is drawn; -1: none. */
function agent() {
  if (app.episode) return app.episode.steps[app.episode.at].state;
  return app.process instanceof Learner && app.process.steps && (!app.playing || rate() < 3000) ? app.process.state : -1;
}

/** Show everything again; what takes long waits while something plays, unless it is `all`. */
function refresh(all = !app.playing) {
  const hasWorld = Boolean(app.world);
  say(app.problem);
  if (hasWorld) rescore();
  if (isMap) drawMap(hasWorld);
  if (hasWorld) showScore(all), showCurve();
  if (all) showControls(), showTexts();
  showCell();
}

function drawMap(hasWorld) {
  const { map } = app, board = $("board"), most = Math.max(260, Math.min(window.innerHeight - 230, 760));
  const wide = Math.min($("stage").clientWidth, 118 * map.cols, (most / map.rows) * map.cols);
  board.style.width = `${wide}px`;
  board.style.height = `${(wide / map.cols) * map.rows}px`;
  if (!hasWorld) {
    const none = () => false;
    return drawBoard($("canvas"), { map, fill: { of: () => null }, number: () => "", arrows: () => [], wrong: none, path: [], agent: -1, selected: app.selected });
  }
  const { world, solution, now, scored } = app, shown = scale();
  const best = s => [0, 1, 2, 3].filter(a => (app.mode === "optimum" ? solution.optimal[s * 4 + a] : a === now.greedy[s]));
  drawBoard($("canvas"), {
    map, fill: shown.byPair ? { of: () => null } : shown, quarter: shown.byPair ? shown : null, number: shown.number,
    arrows: s => (world.absorbing[s] ? [] : best(s)), wrong: isWrong, path: scored.path, agent: agent(), selected: app.hovered >= 0 ? app.hovered : -1,
  });
  $("low").textContent = shown.low;
  $("high").textContent = shown.high;
  $("scale").style.background = gradient(shown.palette);
}

function showScore(all) {
  const { world, solution, scored, settings, mode, process } = app;
  $("regret").textContent = scored.certified ? "0" : precise(scored.regret);
  $("regret").className = scored.certified ? "good" : "bad";
  $("value").textContent = precise(scored.value);
  $("optimum").textContent = precise(atStart(world, solution.v));
  if (!all) return;
  const { goal, trap, length } = outcome(world, scored.policy, Math.min(world.limit, 10000)), percent = x => `${(100 * x).toFixed(x > 0.9995 && x < 1 ? 2 : 1).replace(/\.0+$/, "")} %`;
  const ends = `Within ${world.limit.toLocaleString("en")} steps: goal ${percent(goal)}, trap ${percent(trap)}, ${length.toFixed(1).replace(".0", "")} steps`;
  const how = scored.certified ? "Certified optimal: no policy is better from the start." : "Not optimal.";
  const progress = { value_iteration: () => `Sweep ${process.steps}: ${process.done ? "nothing changes any more. " : `largest change ${process.steps ? short(process.change) : "–"}. `}`, policy_iteration: () => `Policy ${process.steps + 1}: ${process.steps ? `${process.change} actions changed. ` : ""}` }[mode]?.();
  const learnt = process instanceof Learner ? `${process.steps.toLocaleString("en")} steps, ${process.episodes.toLocaleString("en")} episodes. ` : "";
  const seen = mode === "run" ? `After ${run.steps[app.moment].toLocaleString("en")} steps. ` : "";
  $("verdict").textContent = `${progress ?? ""}${learnt}${seen}${how} ${ends}.`;
  $("subtitle").textContent = isMap ? (mode === "run" ? run.title : "") : `${data.title}, γ ${settings.gamma}`;
}

function showCurve() {
  const { process, mode, curve } = app;
  if (process) {
    const last = curve.length ? curve[curve.length - 1][0] : -1;
    if (process.steps > last && process.steps - last >= last / 300) {
      const started = performance.now(), isLearner = process instanceof Learner && app.slow < 12;
      const exploring = isLearner ? score(app.world, app.solution, epsilonGreedy(app.world, process.q, process.settings.epsilon)).regret : NaN;
      if (isLearner) app.slow = performance.now() - started;
      curve.push([process.steps, app.scored.certified ? 0 : app.scored.regret, exploring]);
      if (curve.length > 600) app.curve = curve.filter((_, i) => i % 2 === 0);
    }
  }
  const isRun = mode === "run", canvas = $("curve");
  canvas.hidden = mode === "optimum";
  if (canvas.hidden) return;
  const points = isRun ? run.steps.map((x, i) => [x, run.regrets[i] ?? Infinity]) : app.curve;
  const lines = [...app.old.map((line, i) => ({ ...line, colour: i ? "goal" : "good" })), { points: points.map(([x, y]) => [x, y]), colour: "accent", label: process instanceof Learner ? LEARNERS[mode] : "regret" }];
  if (process instanceof Learner) lines.push({ points: points.map(([x, , y]) => [x, y]).filter(([, y]) => Number.isFinite(y)), colour: "muted", dash: [4, 3], label: "with its ε" });
  drawCurve(canvas, lines, { value_iteration: "sweeps", policy_iteration: "policies" }[mode] ?? "steps", isRun && points[app.moment]);
  canvas.setAttribute("aria-label", `Regret of the greedy policy over steps: ${app.scored.certified ? "0" : short(app.scored.regret)} now`);
}

function showControls() {
  const { mode, settings, world, map } = app, canPlay = world && mode !== "optimum";
  for (const [id, options, current] of [["modes", MODES, mode], ["tools", TOOLS, app.tool]])
    for (const button of $(id).querySelectorAll("[role=radio]")) {
      const is = button.value === current;
      button.setAttribute("aria-checked", is);
      button.tabIndex = is ? 0 : -1;
      if (options === MODES && button.value === "run") button.disabled = !fitsRun();
    }
  $("play").textContent = app.playing ? "Pause" : "Play";
  for (const id of ["play", "step", "reset", "speed-label"]) $(id).hidden = mode === "optimum", $(id).disabled = !canPlay;
  $("moment-label").hidden = mode !== "run";
  if (run) Object.assign($("moment"), { max: run.steps.length - 1, value: app.moment });
  $("learner").hidden = !(mode in LEARNERS);
  for (const [key] of [...FIELDS, ...HYPER]) {
    const value = settings[key] ?? app.hyper[key];
    if (document.activeElement !== $(key)) $(key).value = value;
    $(`${key}-slider`).value = value;
  }
  for (const option of $("show").options) option.disabled = option.value === "visits" && !app.now?.visits;
  $("follow").disabled = $("back").disabled = $("forward").disabled = !world;
  $("undo").disabled = !app.undo.length;
  if (!map) return;
  $("rows").value = map.rows;
  $("cols").value = map.cols;
  $("maps").value = Object.keys(shipped).find(name => shipped[name].text === mapText(map)) ?? "";
  $("command").textContent = world ? commandLine() : "";
  for (const id of ["copy-command", "download"]) $(id).disabled = !world;
  $("grid").classList.toggle("drawing", app.tool !== "look");
}

const commandLine = () => command(app.map, app.settings, shipped, app.mode in LEARNERS ? app.mode : app.mode.endsWith("iteration") ? "value_iteration" : "q_learning");

// ---- text: labels of the cells, the table of states, and one state in detail -----------------------------------------

function describe(s) {
  const { map, world, solution, now } = app, kind = map ? `${KINDS[map.tiles[s]]}` : world.terminal[s] ? (world.goal[s] ? "goal" : "end") : "";
  if (!world || world.absorbing[s] || map?.tiles[s] === "C") return kind;
  const best = world.actions.filter((_, a) => solution.optimal[s * world.A + a]).join(" or ");
  const learnt = app.mode === "optimum" ? "" : `, shown ${short(now.v[s])}, takes ${world.actions[now.greedy[s]]}${isWrong(s) ? ", not optimal" : ""}`;
  return `${kind}, value ${short(solution.v[s])}, best ${best}${learnt}`;
}

function showTexts() {
  if (isMap) {
    [...$("grid").querySelectorAll("[role=gridcell]")].forEach((cell, s) => cell.setAttribute("aria-label", `${cellName(app.map, s)}: ${describe(s)}`));
    return;
  }
  const { world, solution, now } = app, costs = regrets().cost, { A } = world;
  const names = (s, is) => world.actions.filter((_, a) => is(s * A + a, a)).join(", ");
  $("states").querySelector("thead").replaceChildren(h("tr", null, ...["state", "optimal", "V*", "greedy", "V", "regret"].map(text => h("th", { scope: "col" }, text))));
  $("states").querySelector("tbody").replaceChildren(...Array.from({ length: world.n }, (_, s) => {
    const greedy = h("td", { className: isWrong(s) ? "bad" : "" }, world.absorbing[s] ? "" : world.actions[now.greedy[s]]);
    const cells = [world.name(s), world.absorbing[s] ? describe(s) : names(s, at => solution.optimal[at]), short(solution.v[s])].map(text => h("td", null, text));
    return h("tr", { className: s === app.selected ? "is" : "", tabIndex: 0, onclick: () => select(s), onkeydown: event => event.key === "Enter" && select(s) }, ...cells, greedy, h("td", null, short(now.v[s])), h("td", null, short(costs[s])));
  }));
}

function select(state) {
  app.selected = state;
  refresh();
}

function showCell() {
  const s = app.hovered >= 0 ? app.hovered : app.selected, { world, solution, now, map } = app, box = $("cell");
  if (!world || s < 0 || s >= world.n) return box.replaceChildren(h("p", null, "Point at a cell, tap it, or move to it with the arrow keys."));
  const head = h("p", null, h("b", null, world.name(s)), map ? `, ${KINDS[map.tiles[s]]}` : "");
  if (world.absorbing[s] || map?.tiles[s] === "C") return box.replaceChildren(head);
  const { A, K, next, prob, reward } = world, { visits, lost, cost } = regrets(), pairs = Array.from({ length: A }, (_, a) => s * A + a);
  const row = at => {
    const marks = `${at - s * A === now.greedy[s] ? " ●" : ""}${solution.optimal[at] ? " ✓" : ""}`;
    return h("tr", null, ...[world.actions[at - s * A] + marks, short(now.q[at]), short(solution.q[at]), now.visits ? now.visits[at].toLocaleString("en") : "–"].map(text => h("td", null, text)));
  };
  const leads = at => {
    const ways = new Map();
    for (let k = at * K; k < (at + 1) * K; k++) if (prob[k] > 0) ways.set(`${next[k]} ${reward[k]}`, [next[k], reward[k], (ways.get(`${next[k]} ${reward[k]}`)?.[2] ?? 0) + prob[k]]);
    const texts = [...ways.values()].map(([to, r, p]) => `${Number((100 * p).toFixed(1))} % ${to === s ? "stays" : world.name(to)} (${r ? `reward ${short(r)}` : "no reward"}${world.terminal[to] ? ", ends" : `, V* ${short(solution.v[to])}`})`);
    return h("li", null, `${world.actions[at - s * A]}: ${texts.join("; ")}`);
  };
  box.replaceChildren(head,
    h("p", null, `V* ${short(solution.v[s])}, shown ${short(now.v[s])}. ${cost[s] > 0 ? `Costs ${short(cost[s])} of the regret: ${short(visits[s])} discounted visits, each loses ${short(lost[s])}.` : visits[s] > 0 ? "Nothing is lost here." : "The greedy policy does not come here from the start."}`),
    h("table", null, h("thead", null, h("tr", null, ...["action", app.mode === "run" && !now.hasQ ? "Q (one backup)" : "Q", "Q*", "visits"].map(text => h("th", { scope: "col" }, text)))), h("tbody", null, ...pairs.map(row))),
    h("ul", null, ...pairs.map(leads)), h("p", null, "● greedy, ✓ optimal"));
}

// ---- an episode, and time --------------------------------------------------------------------------------------------

function newEpisode() {
  const { world, now, settings } = app, steps = [{ state: drawStart(world, Math.random), text: "start" }];
  let total = 0;
  for (let t = 0, s = steps[0].state; t < Math.min(world.limit, 2000) && !world.terminal[s]; t++) {
    const at = drawOutcome(world, s, now.greedy[s], Math.random), slipped = world.map && at % world.K ? ", slipped" : "";
    total += settings.gamma ** t * world.reward[at];
    steps.push({ state: world.next[at], text: `${world.actions[now.greedy[s]]}${slipped}, reward ${short(world.reward[at])}, discounted return ${short(total)}` });
    s = world.next[at];
  }
  app.episode = { steps, at: 0 };
}

function walk(by) {
  if (!app.episode) newEpisode();
  else app.episode.at = Math.min(Math.max(app.episode.at + by, 0), app.episode.steps.length - 1);
  showEpisode();
}

function showEpisode() {
  const { steps, at } = app.episode ?? {};
  $("episode").textContent = steps ? `step ${at} of ${steps.length - 1}: ${steps[at].text}; ${app.world.name(steps[at].state)}` : "";
  $("follow").textContent = app.following ? "Stop" : "Follow the greedy policy";
}

function rate() {
  const share = $("speed").value / 100;
  return app.process instanceof Learner ? 2 * 10 ** (5 * share) : 10 ** (2 * share);
}

function advance() {
  if (app.mode === "run") app.moment = (app.moment + 1) % run.steps.length;
  else if (!app.process.done) app.process.step();
  if (app.process?.done || (app.mode === "run" && app.moment === run.steps.length - 1)) app.playing = false;
}

let before = 0, labelled = 0;
function frame(time) {
  const passed = Math.min(time - before, 100) / 1000;
  before = time;
  if (app.playing) {
    const end = performance.now() + 9, isLearner = app.process instanceof Learner;
    app.credit = Math.min(app.credit + rate() * passed, rate());
    let moved = false;
    while (app.credit >= 1 && app.playing && performance.now() < end) for (let i = 0; i < (isLearner ? 50 : 1) && app.credit >= 1; i++, app.credit--) advance(), (moved = true);
    if (moved) {
      const all = !app.playing || time - labelled > 400;
      if (all) labelled = time;
      app.episode = null;
      refresh(all);
    }
  } else if (app.following) {
    app.credit += passed * 5;
    if (app.credit >= 1) {
      app.credit = 0;
      walk(1);
      if (app.episode.at === app.episode.steps.length - 1) app.following = false;
      showEpisode();
      if (isMap) drawMap(true);
      else select(agent());
    }
  }
  requestAnimationFrame(frame);
}

// ---- controls --------------------------------------------------------------------------------------------------------

function buildGrid() {
  const { rows, cols, tiles } = app.map, grid = $("grid");
  if (grid.dataset.size === `${rows} ${cols}`) return;
  grid.dataset.size = `${rows} ${cols}`;
  grid.style.grid = `repeat(${rows}, 1fr) / repeat(${cols}, 1fr)`;
  grid.setAttribute("aria-label", `Map of ${rows} rows and ${cols} columns`);
  const cell = s => h("div", { role: "gridcell", tabIndex: s ? -1 : 0 });
  grid.replaceChildren(...Array.from({ length: rows }, (_, row) => h("div", { role: "row" }, ...Array.from({ length: cols }, (_, col) => cell(row * cols + col)))));
  if (app.selected >= tiles.length) app.selected = -1;
}

function radios(id, label, options, choose) {
  const box = $(id);
  for (const [value, text] of Object.entries(options)) box.append(h("button", { role: "radio", value, textContent: text, onclick: () => choose(value) }));
  box.onkeydown = event => {
    const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key], all = [...box.querySelectorAll("[role=radio]:enabled")];
    if (!by) return;
    event.preventDefault();
    const next = all[(all.indexOf(document.activeElement) + by + all.length) % all.length];
    next.focus();
    next.click();
  };
}

function field([key, label, least, most, step], take) {
  const set = (text, isDone) => {
    try {
      take(key, checked(key, text), isDone);
    } catch (error) {
      if (!(error instanceof Mistake)) throw error;
      say(error.message);
    }
  };
  const number = h("input", { id: key, type: "number", step: "any", onchange: event => set(event.target.value, true) });
  const slider = h("input", { id: `${key}-slider`, type: "range", min: least, max: most, step, ariaLabel: `${label}, slider`, oninput: event => set(event.target.value, false) });
  return h("div", { className: "field" }, h("label", { htmlFor: key }, label), slider, number);
}

async function copy(text, button) {
  try {
    await navigator.clipboard.writeText(text);
  } catch { // where the page may not use the clipboard
    const area = document.body.appendChild(h("textarea", { value: text }));
    area.select();
    document.execCommand("copy");
    area.remove();
  }
  const label = button.textContent;
  button.textContent = "Copied";
  setTimeout(() => (button.textContent = label), 1200);
}

function cellAt(event) {
  const box = $("grid").getBoundingClientRect(), { rows, cols } = app.map;
  const col = Math.floor(((event.clientX - box.left) / box.width) * cols), row = Math.floor(((event.clientY - box.top) / box.height) * rows);
  return row >= 0 && row < rows && col >= 0 && col < cols ? row * cols + col : -1;
}

function listen() {
  radios("modes", "What to watch", MODES, mode => ((app.mode = mode), restart(), refresh(), showEpisode()));
  radios("tools", "Drawing tool", TOOLS, tool => ((app.tool = tool), refresh()));
  $("tools").append(h("button", { id: "undo", textContent: "Undo", onclick: undo }));
  $("show").append(...Object.entries(SHOWS).filter(([key]) => isMap || key === "value").map(([value, text]) => h("option", { value, textContent: text })));
  $("show").onchange = event => ((app.show = event.target.value), refresh());
  const change = (key, value, isDone) => {
    const settings = { ...app.settings, [key]: value };
    isDone ? edit(() => setWorld(app.map, settings, true)) : setWorld(app.map, settings, true);
  };
  const more = h("details", null, h("summary", null, "rewards and step limit"), ...FIELDS.slice(3).map(each => field(each, change)));
  $("world").append(...FIELDS.slice(0, 3).map(each => field(each, change)), more);
  const hyper = (key, value) => {
    app.hyper[key] = value;
    if (app.process) app.process.settings = learnerSettings();
    if (key === "initial" && !app.process?.steps) restart();
    refresh();
  };
  $("learner").append(...HYPER.map(each => field(each, hyper)));
  $("maps").append(h("option", { value: "", textContent: "your own" }), ...Object.keys(shipped).map(name => h("option", { value: name, textContent: name })));
  $("maps").onchange = event => event.target.value && edit(() => open(`map=${event.target.value}`));
  $("rows").onchange = $("cols").onchange = () => resize(Math.floor($("rows").value), Math.floor($("cols").value));
  $("play").onclick = () => ((app.playing = !app.playing && !app.process?.done), (app.following = false), refresh(true));
  $("step").onclick = () => ((app.playing = false), advance(), (app.episode = null), refresh());
  $("reset").onclick = () => (restart(), refresh(), showEpisode());
  $("moment").oninput = event => ((app.moment = Number(event.target.value)), (app.episode = null), refresh());
  $("follow").onclick = () => {
    app.following = !app.following;
    if (app.following) (app.playing = false), newEpisode();
    showEpisode(), refresh();
  };
  for (const [id, by] of [["back", -1], ["forward", 1]]) $(id).onclick = () => ((app.following = false), walk(by), refresh());
  $("copy-link").onclick = event => copy(location.href, event.target);
  $("copy-command").onclick = event => copy(commandLine(), event.target);
  $("download").onclick = () => h("a", { href: URL.createObjectURL(new Blob([`${mapText(app.map)}\n`], { type: "text/plain" })), download: "map.txt" }).click();
  $("load").onchange = event => event.target.files[0] && loadFile(event.target.files[0]);
  addEventListener("hashchange", () => isMap && open(location.hash));
  addEventListener("resize", () => refresh());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => refresh());
  onGrid();
}

function undo() {
  const last = app.undo.pop();
  if (last) setWorld(last.map, last.settings, true);
}

function onGrid() {
  const grid = $("grid");
  let drawing = false;
  const move = event => {
    const s = cellAt(event);
    if (drawing && s >= 0) paint(s, app.tool);
    else if (s !== app.hovered && event.pointerType === "mouse") (app.hovered = s), isMap && drawMap(Boolean(app.world)), showCell();
  };
  grid.onpointerdown = event => {
    if (app.tool === "look") return;
    event.preventDefault();
    grid.setPointerCapture(event.pointerId);
    drawing = true;
    edit(() => move(event));
  };
  grid.onpointermove = move;
  grid.onpointerup = grid.onpointercancel = () => (drawing = false);
  grid.onpointerleave = () => ((app.hovered = -1), drawMap(Boolean(app.world)), showCell());
  grid.onclick = event => app.tool === "look" && focusCell(cellAt(event));
  grid.addEventListener("focusin", event => {
    app.selected = [...grid.querySelectorAll("[role=gridcell]")].indexOf(event.target);
    showCell();
  });
  grid.onkeydown = event => {
    const { rows, cols } = app.map, s = app.selected, row = Math.floor(s / cols), col = s % cols, key = event.key;
    const to = { ArrowUp: row && s - cols, ArrowDown: row < rows - 1 ? s + cols : s, ArrowLeft: col ? s - 1 : s, ArrowRight: col < cols - 1 ? s + 1 : s, Home: row * cols, End: (row + 1) * cols - 1 }[key];
    if (to !== undefined) event.preventDefault(), focusCell(key === "ArrowUp" && !row ? s : to);
    const tile = key === "Enter" || key === " " ? app.tool : key.toUpperCase() === "W" ? "#" : key.toUpperCase();
    if (tile in KINDS && !event.ctrlKey && !event.metaKey) event.preventDefault(), edit(() => paint(s, tile));
    if (key.toLowerCase() === "z") undo();
  };
}

function focusCell(s) {
  const cells = [...$("grid").querySelectorAll("[role=gridcell]")];
  cells.forEach((cell, at) => (cell.tabIndex = at === s ? 0 : -1));
  cells[s]?.focus();
}

for (const id of isMap ? ["states"] : ["board", "tools", "share", "legend"]) $(id).hidden = true;
if (!isMap) $("states").hidden = false, $("world").querySelector(".bar").hidden = true;
listen();
if (run && isMap) {
  const { map, settings } = readLink(data.link, shipped);
  app.runLink = link(map, settings, shipped);
}
if (isMap) open(location.hash || data.link || "");
else {
  for (const box of [$("slip").closest(".field"), $("step_reward").closest(".field"), $("world").querySelector("details"), $("show").parentNode]) box.hidden = true;
  setWorld(null, { ...SETTINGS, gamma: data.gamma });
}
showEpisode();
requestAnimationFrame(frame);
globalThis.playground = { app, compile, evaluate, Learner, outcome, parse, score, solve, split }; // for the console
