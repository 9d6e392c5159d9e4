// A map, what is wrong with it, its tables, its link and its command line; as gridworld/world/{layout,grid}.py.

export const MOVES = [[-1, 0], [0, 1], [1, 0], [0, -1]]; // up, right, down, left
export const MOST_SIDE = 60, MOST_CELLS = 2500;
const DEFAULTS = { slip: 0, step_reward: 0, goal_reward: 1, trap_reward: -1, max_episode_steps: 100 };
export const SETTINGS = { ...DEFAULTS, gamma: 0.99 };

/** A mistake in a map, a link or a file, in one sentence. */
export class Mistake extends Error {}

function refuse(sentence) {
  throw new Mistake(sentence);
}

/** A number within the bounds of a setting, from a link or a field. */
export function checked(key, text) {
  const number = Number(text), size = Math.abs(number);
  if (!/^-?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$/i.test(text) || text.length > 30 || !Number.isFinite(number))
    refuse(`${key}: must be a number`);
  if ((key === "slip" || key === "gamma") && !(number >= 0 && number <= 1)) refuse(`${key}: must be from 0 to 1`);
  if (key === "gamma" && number < 1 && number > 1 - 1e-11) refuse("gamma: is too close to 1; must be 1 or smaller");
  if (key.endsWith("_reward") && number !== 0 && !(size >= 1e-30 && size <= 1e15))
    refuse(`${key}: must be 0, or from 1e-30 to 1e15 in absolute value`);
  if (key === "max_episode_steps" && !(Number.isInteger(number) && number >= 1 && number <= 1e5))
    refuse("max_episode_steps: must be a whole number from 1 to 100,000");
  return number;
}

export function emptyMap(rows, cols) {
  const tiles = new Array(rows * cols).fill(".");
  tiles[0] = "S";
  tiles[rows * cols - 1] = "G";
  return { rows, cols, tiles: tiles.join("") };
}

/** Read a map from its text, a line a row and a sign a cell. */
export function parse(text) {
  if (text.length > 4 * MOST_CELLS) refuse(`the map is too large; at most ${MOST_CELLS} cells fit here`);
  const lines = text.replace(/^\ufeff/, "").replace(/\r\n?/g, "\n").trimEnd().split("\n").map(line => line.trimEnd());
  const rows = lines.length, cols = lines[0].length;
  if (!cols) refuse("the map is empty; it needs at least a start 'S' and a goal 'G'");
  if (rows > MOST_SIDE || cols > MOST_SIDE || rows * cols > MOST_CELLS)
    refuse(`${rows} rows of ${cols} columns are too large; at most ${MOST_CELLS} cells fit, ${MOST_SIDE} in a row`);
  lines.forEach((line, row) => {
    lines[row] = line = line.replaceAll("H", "T").replaceAll("F", "."); // as FrozenLake has them
    const strange = line.search(/[^SGTC#.]/);
    if (strange >= 0)
      refuse(`row ${row + 1}, column ${strange + 1}: unknown tile; use S (start), G (goal), T (trap), C (cliff), ` +
        "# (wall) and . (floor)");
    if (line.length !== cols)
      refuse(`row ${row + 1} has ${line.length} columns, row 1 has ${cols}; all rows must have equal lengths`);
  });
  return { rows, cols, tiles: lines.join("") };
}

export function mapText(map) {
  return Array.from({ length: map.rows }, (_, row) => map.tiles.slice(row * map.cols, (row + 1) * map.cols)).join("\n");
}

export function cellName(map, state) {
  return `row ${Math.floor(state / map.cols) + 1}, column ${state % map.cols + 1}`;
}

function neighbour(map, state, action) {
  const row = Math.floor(state / map.cols) + MOVES[action][0], col = state % map.cols + MOVES[action][1];
  return row < 0 || row >= map.rows || col < 0 || col >= map.cols ? state : row * map.cols + col;
}

/** Refuse a map that cannot be played. */
export function check(map, settings) {
  const where = tile => [...Array(map.tiles.length).keys()].filter(state => map.tiles[state] === tile);
  const starts = where("S"), goals = where("G"), cliffs = where("C");
  if (!starts.length) refuse("there is no start; mark at least one cell with 'S'");
  if (!goals.length) refuse("there is no goal; mark at least one cell with 'G'");
  if (cliffs.length && starts.length > 1)
    refuse(`a cliff 'C' leads back to the start, but there are ${starts.length}; keep one 'S'`);
  if (cliffs.length && settings.trap_reward > 0)
    refuse("trap_reward: must be at most 0 on maps with a cliff, since the agent may fall again and again");
  const seen = new Set(goals), waiting = [...goals];
  while (waiting.length) {
    const state = waiting.pop();
    for (let action = 0; action < 4; action++) {
      const near = neighbour(map, state, action);
      if (!seen.has(near) && !"#TC".includes(map.tiles[near])) waiting.push(near), seen.add(near);
    }
  }
  const lost = starts.find(state => !seen.has(state));
  if (lost !== undefined)
    refuse(`no goal can be reached from the start in ${cellName(map, lost)}; open a way past walls, traps and cliffs`);
}

/** Compile a map into tables: `next`, `prob`, `reward` are (S, A, K), flat. */
export function compile(map, settings) {
  check(map, settings);
  const n = map.tiles.length, slip = settings.slip, A = 4, K = slip === 0 ? 1 : 3;
  const is = tiles => Uint8Array.from(map.tiles, tile => tiles.includes(tile));
  const goal = is("G"), terminal = is("GT"), absorbing = is("GT#"), starts = is("S");
  const count = starts.reduce((sum, each) => sum + each), first = map.tiles.indexOf("S");
  const next = new Int32Array(n * A * K), prob = new Float64Array(n * A * K), reward = new Float64Array(n * A * K);
  const chances = K === 1 ? [1] : [1 - slip, slip / 2, slip / 2];
  for (let s = 0, at = 0; s < n; s++)
    for (let a = 0; a < A; a++)
      for (let k = 0; k < K; k++, at++) {
        let to = neighbour(map, s, (a + [0, 1, 3][k]) % 4); // the move itself, then those at right angles
        if (map.tiles[to] === "#") to = s;
        const tile = map.tiles[to];
        prob[at] = chances[k];
        next[at] = absorbing[s] ? s : tile === "C" ? first : to;
        const entered = tile === "G" ? settings.goal_reward : "TC".includes(tile) ? settings.trap_reward : 0;
        reward[at] = absorbing[s] ? 0 : settings.step_reward + entered;
      }
  return finish({
    n, A, K, next, prob, reward, terminal, goal, absorbing, map,
    thresholds: Float64Array.from({ length: n * A * (K - 1) }, (_, at) => 1 - slip / (1 + at % 2)),
    start: Float64Array.from(starts, each => each / count),
    actions: ["up", "right", "down", "left"],
    name: s => cellName(map, s),
    limit: settings.max_episode_steps,
  });
}

/** The world of tables that were written into the page. */
export function fromTables(data) {
  return finish({
    ...data,
    next: Int32Array.from(data.next),
    ...Object.fromEntries(["prob", "reward", "start", "thresholds"].map(key => [key, Float64Array.from(data[key])])),
    ...Object.fromEntries(["terminal", "goal", "absorbing"].map(key => [key, Uint8Array.from(data[key])])),
    name: s => data.names[s],
  });
}

/** Add what follows from the tables: the predecessors of each state, and the states with a start. */
function finish(world) {
  const { n, next } = world, first = new Int32Array(n + 1), into = new Int32Array(next.length);
  for (const to of next) first[to + 1]++;
  for (let s = 0; s < n; s++) first[s + 1] += first[s];
  const filled = first.slice();
  next.forEach((to, at) => (into[filled[to]++] = at));
  world.predecessors = { first, into };
  world.starts = [...world.start.keys()].filter(s => world.start[s] > 0);
  return world;
}

/** The link's part behind `#`; a shipped map has its name there. */
export function link(map, settings, shipped) {
  const name = Object.keys(shipped).find(each => shipped[each].text === mapText(map));
  const base = name ? shipped[name].settings : SETTINGS;
  const changed = Object.keys(SETTINGS).filter(key => settings[key] !== base[key]);
  const tiles = name ?? mapText(map).replaceAll("#", "W").replaceAll("\n", "_");
  return [`map=${tiles}`, ...changed.map(key => `${key}=${settings[key]}`)].join("&");
}

/** What a link means; raises `Mistake`. */
export function readLink(hash, shipped) {
  const found = new Map(hash.replace(/^#/, "").split("&").filter(Boolean).map(part => part.split("=", 2)));
  const tiles = found.get("map") ?? "classic";
  found.delete("map");
  const named = Object.hasOwn(shipped, tiles);
  if (!named && !/^[SGTCW._]+$/.test(tiles))
    refuse("map: must be a shipped map's name, or rows of S, G, T, C, W and .");
  const map = parse(named ? shipped[tiles].text : tiles.replaceAll("W", "#").replaceAll("_", "\n"));
  const settings = { ...(named ? shipped[tiles].settings : SETTINGS) };
  for (const [key, text] of found) {
    if (!Object.hasOwn(SETTINGS, key)) refuse("the link has an unknown setting; is it another version's?");
    settings[key] = checked(key, text ?? "");
  }
  return { map, settings };
}

/** The command line that trains an agent in exactly this world. */
export function command(map, settings, shipped, agent) {
  const text = mapText(map), name = Object.keys(shipped).find(each => shipped[each].text === text);
  const base = name ? shipped[name].settings : SETTINGS;
  const changed = Object.keys(DEFAULTS).filter(key => settings[key] !== base[key]);
  const words = changed.map(key => `env.${key}=${settings[key]}`);
  if (settings.gamma !== 0.99) words.push(`agent.gamma=${settings.gamma}`, `evaluation.gamma=${settings.gamma}`);
  const world = name ? `env=${name}` : "env.layout=map.txt";
  const written = name ? "" : `printf '${text.replaceAll("\n", "\\n")}\\n' > map.txt && `;
  return `${written}gridworld train ${[`agent=${agent}`, world, ...words].join(" ")}`;
}
