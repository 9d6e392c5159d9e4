// What people do: they draw a world, choose what to watch, play it, and take it with them.

import { $, agent, app, commandLine, data, drawMap, FIELDS, fitsRun, h, HYPER, isEmbedded, isMap, LEARNERS } from "./show.js";
import { MODES, rate, refresh, run, say, select, shipped, showCell, showControls, SHOWS, TOOLS } from "./show.js";
import { evaluate, outcome, score, solve, split } from "./solver.js";
import { drawOutcome, drawStart, Learner, PolicyIteration, ValueIteration } from "./learners.js";
import { short } from "./view.js";
import { check, checked, compile, emptyMap, fromTables, link, mapText, Mistake } from "./world.js";
import { MOST_CELLS, MOST_SIDE, parse, readLink, SETTINGS } from "./world.js";

const hasAddress = location.protocol !== "about:"; // none in a notebook

// ---- the world ------------------------------------------------------------------------------------------

/** Take another world; a mistake in it is shown. To `keep` what learns, it learns on in the new one. */
function setWorld(map, settings, keep = false) {
  Object.assign(app, { map, settings, problem: "", world: null, solution: null, old: [], episode: null });
  try {
    const world = isMap ? compile(map, settings) : fromTables(data.tables);
    Object.assign(app, { solution: solve(world, settings.gamma), world });
  } catch (error) {
    if (!(error instanceof Mistake)) throw error;
    Object.assign(app, { problem: error.message, playing: false, following: false });
  }
  if (isMap) {
    app.link = link(map, settings, shipped);
    clearTimeout(app.linking); // browsers refuse too many changes of the address
    if (hasAddress) app.linking = setTimeout(() => history.replaceState(null, "", `#${app.link}`), 200);
    buildGrid();
  }
  const { process, world } = app, learnsOn = keep && process instanceof Learner;
  if (app.mode === "run" && !fitsRun()) app.mode = "optimum";
  if (!learnsOn || (world && world.n !== process.world.n)) restart();
  else if (world) process.adopt(world), (process.settings = learnerSettings());
  refresh();
}

const learnerSettings = () => ({ ...app.hyper, gamma: app.settings.gamma });

function restart() {
  const { mode, world, process, curve } = app, random = { world: Math.random, agent: Math.random };
  if (process instanceof Learner && curve.length > 2 && mode !== process.kind && mode in LEARNERS)
    app.old = [...app.old, { label: LEARNERS[process.kind], points: curve }].slice(-2); // to compare with
  Object.assign(app, { playing: false, following: false, episode: null, curve: [], credit: 0, process: null });
  if (!world || mode === "optimum") return;
  if (mode === "run") app.moment = run.steps.length - 1;
  else if (mode in LEARNERS) app.process = new Learner(world, mode, learnerSettings(), random);
  else app.process = new (mode === "value_iteration" ? ValueIteration : PolicyIteration)(world, learnerSettings());
}

const remember = () => (app.undo = [...app.undo.slice(-99), [app.map, app.settings]]);

function undo() {
  const last = app.undo.pop();
  if (last) setWorld(...last, true);
}

function paint(state, tile) {
  const { tiles } = app.map;
  if (tiles[state] === tile) return;
  setWorld({ ...app.map, tiles: tiles.slice(0, state) + tile + tiles.slice(state + 1) }, app.settings, true);
}

function resize(rows, cols) {
  const old = app.map, count = rows * cols;
  if (!(rows >= 1 && cols >= 1 && count >= 2 && count <= MOST_CELLS && Math.max(rows, cols) <= MOST_SIDE))
    return say(`the map: must have from 2 to ${MOST_CELLS} cells, and at most ${MOST_SIDE} in a row or column`),
      showControls();
  const tiles = Array.from({ length: count }, (_, s) => {
    const row = Math.floor(s / cols), col = s % cols;
    return row < old.rows && col < old.cols ? old.tiles[row * old.cols + col] : ".";
  });
  const { tiles: empty } = emptyMap(rows, cols);
  for (const tile of "SG") if (!tiles.includes(tile)) tiles[empty.indexOf(tile)] = tile;
  remember();
  setWorld({ rows, cols, tiles: tiles.join("") }, app.settings);
}

function open(hash) {
  try {
    const { map, settings } = readLink(hash, shipped);
    setWorld(map, settings);
  } catch (error) {
    if (!(error instanceof Mistake)) throw error;
    if (!app.map) open("");
    say(error.message);
  }
}

async function loadFile(file) {
  try {
    if (file.size > 4 * MOST_CELLS) throw new Mistake("the file is too large for a map");
    const map = parse(await file.text());
    check(map, app.settings);
    remember();
    setWorld(map, app.settings);
  } catch (error) {
    say(`${file.name.slice(0, 80)}: ${error instanceof Mistake ? error.message : "cannot be read"}`);
  }
}

// ---- an episode, and time -------------------------------------------------------------------------------

function newEpisode() {
  const { world, now, settings } = app;
  const steps = [{ state: drawStart(world, Math.random), text: "start" }];
  let total = 0;
  for (let t = 0, s = steps[0].state; t < Math.min(world.limit, 2000) && !world.terminal[s]; t++) {
    const at = drawOutcome(world, s, now.greedy[s], Math.random), name = world.actions[now.greedy[s]];
    total += settings.gamma ** t * world.reward[at];
    const numbers = `reward ${short(world.reward[at])}, discounted return ${short(total)}`;
    s = world.next[at];
    steps.push({ state: s, text: `${name}${isMap && at % world.K ? ", slipped" : ""}, ${numbers}` });
  }
  app.episode = { steps, at: 0 };
}

function walk(by) {
  if (!app.episode) newEpisode();
  else app.episode.at = Math.min(Math.max(app.episode.at + by, 0), app.episode.steps.length - 1);
  if (app.episode.at === app.episode.steps.length - 1) app.following = false;
}

/** One step of what is watched. */
function advance() {
  if (app.mode === "run") app.moment = (app.moment + 1) % run.steps.length;
  else if (!app.process.done) app.process.step();
  if (app.process?.done || (app.mode === "run" && app.moment === run.steps.length - 1)) app.playing = false;
}

let before = 0, labelled = 0;
function frame(time) {
  const passed = Math.min(time - before, 100) / 1000, end = performance.now() + 9;
  before = time;
  app.credit += passed * (app.playing ? rate() : app.following ? 5 : 0);
  if (app.playing) {
    const atOnce = app.process instanceof Learner ? 50 : 1, had = (app.credit = Math.min(app.credit, rate()));
    while (app.credit >= 1 && app.playing && performance.now() < end)
      for (let i = 0; i < atOnce && app.credit >= 1 && app.playing; i++, app.credit--) advance();
    if (app.credit < had) {
      const all = !app.playing || time - labelled > 400; // texts need not be read as often
      if (all) labelled = time;
      app.episode = null;
      refresh(all);
    }
  } else if (app.following && app.credit >= 1) {
    app.credit = 0;
    walk(1);
    showControls();
    if (isMap) drawMap();
    else select(agent());
  }
  requestAnimationFrame(frame);
}

// ---- controls -------------------------------------------------------------------------------------------

function buildGrid() {
  const { rows, cols, tiles } = app.map, grid = $("grid"), size = `${rows} ${cols}`;
  if (grid.dataset.size === size) return;
  grid.dataset.size = size;
  grid.style.grid = `repeat(${rows}, 1fr) / repeat(${cols}, 1fr)`;
  grid.setAttribute("aria-label", `Map of ${rows} rows and ${cols} columns`);
  const cells = Array.from(tiles, (_, s) => h("div", { role: "gridcell", tabIndex: s ? -1 : 0 }));
  const rowOf = row => h("div", { role: "row" }, ...cells.slice(row * cols, (row + 1) * cols));
  grid.replaceChildren(...Array.from({ length: rows }, (_, row) => rowOf(row)));
  app.selected = app.hovered = -1;
}

function radios(id, options, choose) {
  const box = $(id);
  for (const [value, textContent] of Object.entries(options))
    box.append(h("button", { role: "radio", value, textContent, onclick: () => choose(value) }));
  box.onkeydown = event => {
    const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    const all = [...box.querySelectorAll("[role=radio]:enabled")], at = all.indexOf(document.activeElement);
    if (!by || at < 0) return;
    event.preventDefault();
    const next = all[(at + by + all.length) % all.length];
    next.focus();
    next.click();
  };
}

/** A labelled number with a slider; `take` gets its key, its value, and whether it stays. */
function field([key, label, min, max, step], take) {
  const set = isDone => event => {
    try {
      take(key, checked(key, event.target.value), isDone);
    } catch (error) {
      if (!(error instanceof Mistake)) throw error;
      say(error.message);
    }
  };
  const number = h("input", { id: key, type: "number", step: "any", onchange: set(true) });
  const rest = { min, max, step, ariaLabel: `${label}, slider`, oninput: set(false), onchange: set(true) };
  const slider = h("input", { id: `${key}-slider`, type: "range", ...rest });
  return h("div", { className: "field" }, h("label", { htmlFor: key }, label), slider, number);
}

async function copy(text, button) {
  try {
    await navigator.clipboard.writeText(text);
  } catch { // where a page from a file may not
    const area = document.body.appendChild(h("textarea", { value: text }));
    area.select();
    document.execCommand("copy");
    area.remove();
  }
  const label = button.textContent;
  button.textContent = "Copied";
  setTimeout(() => (button.textContent = label), 1200);
}

function download() {
  const href = URL.createObjectURL(new Blob([`${mapText(app.map)}\n`], { type: "text/plain" }));
  h("a", { href, download: "map.txt" }).click();
}

function listen() {
  const then = act => event => (act(event), refresh());
  radios("modes", MODES, mode => ((app.mode = mode), restart(), refresh()));
  radios("tools", TOOLS, tool => ((app.tool = tool), refresh()));
  $("tools").append(h("button", { id: "undo", textContent: "Undo", onclick: undo }));
  $("show").append(...Object.entries(SHOWS).map(([value, textContent]) => h("option", { value, textContent })));
  $("show").onchange = then(event => (app.show = event.target.value));
  let isSliding = false;
  const change = (key, value, isDone) => {
    if (!isSliding) remember();
    isSliding = !isDone;
    setWorld(app.map, { ...app.settings, [key]: value }, true);
  };
  const hyper = (key, value) => {
    app.hyper[key] = value;
    if (key === "initial" && !app.process?.steps) restart();
    if (app.process) app.process.settings = learnerSettings();
    refresh();
  };
  const more = FIELDS.slice(3).map(each => field(each, change));
  const summary = h("summary", null, "rewards and step limit");
  $("world").append(...FIELDS.slice(0, 3).map(each => field(each, change)), h("details", null, summary, ...more));
  $("learner").append(...HYPER.map(each => field(each, hyper)));
  const names = Object.fromEntries(Object.keys(shipped).map(name => [name, name]));
  const worlds = { "": "your own", ...(data.link && { given: "as given" }), ...names };
  $("maps").append(...Object.entries(worlds).map(([value, textContent]) => h("option", { value, textContent })));
  $("maps").onchange = event => {
    const name = event.target.value;
    if (name) remember(), open(name === "given" ? data.link : `map=${name}`);
  };
  $("rows").onchange = $("cols").onchange = () => resize(Math.floor($("rows").value), Math.floor($("cols").value));
  $("play").onclick = () => {
    Object.assign(app, { playing: !app.playing && !app.process?.done, following: false });
    refresh(true);
  };
  $("step").onclick = then(() => (advance(), Object.assign(app, { playing: false, episode: null })));
  $("reset").onclick = then(restart);
  $("moment").oninput = then(event => Object.assign(app, { moment: Number(event.target.value), episode: null }));
  $("follow").onclick = then(() => {
    Object.assign(app, { following: !app.following, playing: false });
    if (app.following) newEpisode();
  });
  const step = by => then(() => ((app.following = false), walk(by)));
  Object.assign($("back"), { onclick: step(-1) }), Object.assign($("forward"), { onclick: step(1) });
  $("copy-link").onclick = event => copy(`${location.href.split("#")[0]}#${app.link}`, event.target);
  $("copy-command").onclick = event => copy(commandLine(), event.target);
  $("download").onclick = download;
  $("load").onchange = event => event.target.files[0] && loadFile(event.target.files[0]);
  addEventListener("hashchange", event => {
    const { hash } = new URL(event.newURL);
    clearTimeout(app.linking);
    if (isMap && hash !== `#${app.link}`) open(hash);
  });
  addEventListener("resize", () => refresh());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => refresh());
}

function onGrid() {
  const grid = $("grid"), cells = () => [...grid.querySelectorAll("[role=gridcell]")];
  let drawing = false;
  const stateAt = event => {
    const box = grid.getBoundingClientRect(), { rows, cols } = app.map;
    const col = Math.floor(((event.clientX - box.left) / box.width) * cols);
    const row = Math.floor(((event.clientY - box.top) / box.height) * rows);
    return row >= 0 && row < rows && col >= 0 && col < cols ? row * cols + col : -1;
  };
  const hover = state => state !== app.hovered && ((app.hovered = state), drawMap(), showCell());
  const focus = state => {
    cells().forEach((cell, at) => (cell.tabIndex = at === state ? 0 : -1));
    cells()[state]?.focus();
  };
  grid.onpointerdown = event => {
    if (app.tool === "look") return;
    event.preventDefault();
    grid.setPointerCapture(event.pointerId);
    drawing = true;
    remember();
    grid.onpointermove(event);
  };
  grid.onpointermove = event => {
    const state = stateAt(event);
    if (drawing && state >= 0) paint(state, app.tool);
    else if (event.pointerType === "mouse") hover(state);
  };
  grid.onpointerup = grid.onpointercancel = () => (drawing = false);
  grid.onpointerleave = () => hover(-1);
  grid.onclick = event => app.tool === "look" && focus(stateAt(event));
  grid.addEventListener("focusin", event => ((app.selected = cells().indexOf(event.target)), showCell()));
  grid.onkeydown = event => {
    const { rows, cols } = app.map, s = app.selected, row = Math.floor(s / cols), col = s % cols, { key } = event;
    const moves = { ArrowUp: row ? s - cols : s, ArrowDown: row < rows - 1 ? s + cols : s, ArrowLeft: col ? s - 1 : s,
      ArrowRight: col < cols - 1 ? s + 1 : s, Home: row * cols, End: (row + 1) * cols - 1 };
    const tile = key === "Enter" || key === " " ? app.tool : key.toUpperCase() === "W" ? "#" : key.toUpperCase();
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (key in moves) focus(moves[key]);
    else if (tile in TOOLS && tile !== "look") remember(), paint(s, tile);
    else if (tile === "Z") undo();
    else return;
    event.preventDefault();
  };
}

function start() {
  for (const id of isMap ? ["states"] : ["board", "tools", "share", "legend"]) $(id).hidden = true;
  listen();
  if (isMap) {
    onGrid();
    const given = readLink(data.link, shipped);
    app.runLink = link(given.map, given.settings, shipped);
    open(location.hash || data.link);
  } else {
    const unused = [$("world").querySelector(".bar"), $("world").querySelector("details"), $("show").parentNode];
    for (const box of [...unused, $("slip").parentNode, $("step_reward").parentNode]) box.hidden = true;
    setWorld(null, { ...SETTINGS, gamma: data.gamma });
  }
  $("copy-link").hidden = !hasAddress;
  if (isEmbedded) {
    document.documentElement.className = "embedded";
    const high = () => Math.ceil(document.body.getBoundingClientRect().height);
    new ResizeObserver(() => parent.postMessage({ playground: high() }, "*")).observe(document.body); // to `FRAME`
  }
  requestAnimationFrame(frame);
}

start();
globalThis.playground = { app, compile, evaluate, Learner, outcome, parse, rate, score, solve, split }; // for the console
