// Drawing: the board and the curve, on canvases whose colours are the page's.

import { MOVES } from "./world.js";

const PALETTES = { // from matplotlib's viridis, and ColorBrewer's OrRd
  viridis: "440154 482878 3e4a89 31688e 26828e 1f9e89 35b779 6ece58 b5de2b fde725",
  oranges: "fff7ec fee8c8 fdd49e fdbb84 fc8d59 ef6548 d7301f b30000 7f0000",
};
for (const [name, hexes] of Object.entries(PALETTES))
  PALETTES[name] = hexes.split(" ").map(hex => [0, 2, 4].map(at => parseInt(hex.slice(at, at + 2), 16)));
const THEME = ["ink", "muted", "line", "accent", "wall", "cell", "wrong", "good", "goal", "trap"];
const AGENT = "#6464dc", FONT = 'system-ui, "Liberation Sans", sans-serif';

export const gradient = name => `linear-gradient(90deg, ${PALETTES[name].map(rgb => `rgb(${rgb})`)})`;

/** A palette's colour for t from 0 to 1, and the ink that is legible on it. */
function shade(name, t) {
  const palette = PALETTES[name], x = Math.min(Math.max(t || 0, 0), 1) * (palette.length - 1);
  const i = Math.min(Math.floor(x), palette.length - 2);
  const [r, g, b] = palette[i].map((from, c) => Math.round(from + (x - i) * (palette[i + 1][c] - from)));
  return { colour: `rgb(${r}, ${g}, ${b})`, ink: 0.3 * r + 0.59 * g + 0.11 * b > 140 ? "#111" : "#fff" };
}

/** A number in four digits. */
export const precise = x => (Number.isFinite(x) ? `${Number(x.toPrecision(4))}`.replace("-", "−") : short(x));

/** A number in two or three digits. */
export function short(x) {
  if (Number.isNaN(x)) return "–";
  if (!Number.isFinite(x)) return x > 0 ? "∞" : "−∞";
  const size = Math.abs(x), digits = size >= 100 ? 0 : size >= 10 ? 1 : 2;
  return (size >= 1e5 || (size > 0 && size < 5e-3) ? x.toExponential(0) : x.toFixed(digits)).replace("-", "−");
}

function theme() {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(THEME.map(name => [name, style.getPropertyValue(`--${name}`).trim()]));
}

// ---- shapes ---------------------------------------------------------------------------------------------

function line(points) {
  const path = new Path2D();
  points.forEach(([x, y]) => path.lineTo(x, y));
  return path;
}

function circle(x, y, radius) {
  const path = new Path2D();
  path.arc(x, y, radius, 0, 7);
  return path;
}

function square(x, y, side, round) {
  const path = new Path2D();
  path.roundRect(x, y, side, side, round);
  return path;
}

function fill(ctx, path, colour) {
  ctx.fillStyle = colour;
  ctx.fill(path);
}

function stroke(ctx, path, colour, width) {
  ctx.strokeStyle = colour;
  ctx.lineWidth = width;
  ctx.stroke(path);
}

function write(ctx, text, x, y, colour, font, most, halo) {
  ctx.font = `${font} ${FONT}`;
  Object.assign(ctx, { fillStyle: colour, strokeStyle: halo, lineWidth: 4 });
  if (halo) ctx.strokeText(text, x, y, most);
  ctx.fillText(text, x, y, most);
}

/** An arrow through the middle of a cell of side c, or of several a slimmer one from there. */
function arrow(x, y, action, c, isOne) {
  const [down, right] = MOVES[action];
  const at = (along, across) => [x + c * (right * along - down * across), y + c * (down * along + right * across)];
  const [from, neck, tip, thin, wide] = isOne ? [-0.26, 0.06, 0.27, 0.045, 0.14] : [0, 0.15, 0.3, 0.03, 0.1];
  const back = [at(neck, wide), at(neck, thin), at(from, thin)];
  return line([at(from, -thin), at(neck, -thin), at(neck, -wide), at(tip, 0), ...back]);
}

/** A context for a canvas in its size on the page, in CSS pixels. */
function context(canvas) {
  const ratio = window.devicePixelRatio || 1, { clientWidth: width, clientHeight: height } = canvas;
  const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)], ctx = canvas.getContext("2d");
  if (canvas.width !== wide || canvas.height !== high) Object.assign(canvas, { width: wide, height: high });
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, width, height);
  Object.assign(ctx, { textAlign: "center", textBaseline: "middle", lineJoin: "round", lineCap: "round" });
  return { ctx, width, height };
}

// ---- the board ------------------------------------------------------------------------------------------

/**
 * Draw a map. `scene` has the map and what is to be seen of its states s: `fill` {palette, of(s): t or null}; `quarter`
 * {palette, of(pair): t, texts(pair): lines}, of states and actions, or nothing; `number(s)`, `arrows(s)`: actions,
 * `wrong(s)`; `path`: states; `agent` and `selected`: a state or -1.
 */
export function drawBoard(canvas, scene) {
  const { ctx, width } = context(canvas), colours = theme(), { map, quarter } = scene, c = width / map.cols;
  const round = c >= 20 ? Math.min(5, c * 0.07) : 0, gap = c >= 12 ? 1 : 0.25, inks = [], fills = [];
  const hasNumber = c >= 42 && !quarter, lift = hasNumber ? 0.09 * c : 0;
  const centre = s => [(s % map.cols + 0.5) * c, (Math.floor(s / map.cols) + 0.5) * c];
  const box = (s, inset) => {
    const [x, y] = centre(s), side = c - 2 * inset;
    return square(x - side / 2, y - side / 2, side, round);
  };
  for (let s = 0; s < map.tiles.length; s++) {
    const tile = map.tiles[s], [x, y] = centre(s), t = "#GTC".includes(tile) ? null : scene.fill.of(s);
    const plain = { colour: tile === "#" ? colours.wall : colours.cell, ink: colours.ink };
    const { colour, ink } = t === null ? plain : shade(scene.fill.palette, t);
    inks.push(ink), fills.push(colour);
    fill(ctx, box(s, gap), colour);
    const [top, bottom, wide] = [y - 0.3 * c, y + 0.28 * c, 0.3 * c];
    if (tile === "G") fill(ctx, line([[x, top], [x + wide, bottom], [x - wide, bottom]]), colours.goal);
    if (tile === "T") fill(ctx, circle(x, y, c / 3.2), colours.trap);
    if (tile === "C") hatch(ctx, box(s, gap), x, y, c, colours.trap);
    if (quarter && !"#GTC".includes(tile)) drawQuarters(ctx, quarter, s, x, y, c / 2 - gap);
  }
  if (!quarter) {
    const path = line(scene.path.map(s => [centre(s)[0], centre(s)[1] - lift]));
    stroke(ctx, path, "rgba(255, 255, 255, .8)", Math.max(1.5, c * 0.1));
    stroke(ctx, path, AGENT, Math.max(1.5, c * 0.055));
  }
  for (let s = 0; s < map.tiles.length; s++) {
    if ("#GTC".includes(map.tiles[s])) continue;
    const [x, y] = centre(s), actions = quarter && c >= 54 ? [] : scene.arrows(s), ring = circle(x, y - lift, c * 0.36);
    if (map.tiles[s] === "S" && !quarter) stroke(ctx, ring, "#fff", c * 0.06), stroke(ctx, ring, AGENT, c * 0.035);
    for (const a of actions) fill(ctx, arrow(x, y - lift, a, c, actions.length === 1), quarter ? "#fff" : inks[s]);
    const font = `600 ${Math.min(15, c * 0.2)}px`;
    if (hasNumber) write(ctx, scene.number(s), x, y + 0.35 * c, inks[s], font, c * 0.92, fills[s]);
    const frame = Math.max(1.5, c * 0.05);
    if (scene.wrong(s)) stroke(ctx, box(s, gap + frame / 2), colours.wrong, frame);
  }
  if (scene.agent >= 0) {
    const [x, y] = centre(scene.agent), body = square(x - 0.27 * c, y - 0.27 * c, 0.54 * c, 0.1 * c);
    fill(ctx, body, AGENT);
    stroke(ctx, body, "#fff", Math.max(1, c * 0.04));
  }
  if (scene.selected >= 0) stroke(ctx, box(scene.selected, 1.5), colours.accent, 3);
}

/** Stripes within a cell: a cliff. */
function hatch(ctx, box, x, y, c, colour) {
  ctx.save();
  ctx.clip(box);
  for (let i = -1; i <= 1; i += 0.5)
    stroke(ctx, line([[x + (i - 0.5) * c, y + 0.5 * c], [x + (i + 0.5) * c, y - 0.5 * c]]), colour, c * 0.1);
  ctx.restore();
}

/** A cell's four actions as four triangles with what each is worth. */
function drawQuarters(ctx, quarter, s, x, y, half) {
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([right, down]) => [x + right * half, y + down * half]);
  MOVES.forEach(([down, right], a) => {
    const { colour, ink } = shade(quarter.palette, quarter.of(s * 4 + a)), size = Math.min(14, half * 0.28);
    const lines = half < 27 ? [] : quarter.texts(s * 4 + a).slice(0, half < 44 ? 1 : 2);
    const far = half * (right ? 0.64 : 0.68);
    fill(ctx, line([corners[a], corners[(a + 1) % 4], [x, y]]), colour);
    lines.forEach((text, i) => {
      const lower = (i - (lines.length - 1) / 2) * size * 1.05, font = i ? `400 ${size * 0.82}px` : `640 ${size}px`;
      write(ctx, text, x + right * far, y + down * far + lower, ink, font, half * (right ? 0.66 : 1));
    });
  });
  for (const i of [0, 1]) stroke(ctx, line([corners[i], corners[i + 2]]), "rgba(255, 255, 255, .5)", 1);
}

// ---- the curve ------------------------------------------------------------------------------------------

/** Draw `lines` {points: [[x, y]], colour: of the theme, dash, label} over y >= 0, and a dot at the point `mark`. */
export function drawCurve(canvas, lines, unit, mark) {
  const { ctx, width, height } = context(canvas), colours = theme();
  const left = 44, right = width - 8, bottom = height - 20, top = 24, points = lines.flatMap(each => each.points);
  const mostX = points.reduce((most, [x]) => Math.max(most, x), 1);
  const mostY = points.reduce((most, [, y]) => (Number.isFinite(y) ? Math.max(most, y) : most), 0) || 1;
  const at = ([x, y]) => [
    left + (x / mostX) * (right - left),
    bottom - (Math.min(Math.max(y / mostY, 0), 1.04) / 1.04) * (bottom - top), // what is infinite is at the top
  ];
  for (const share of [0, 0.5, 1]) {
    const y = at([0, mostY * share])[1];
    stroke(ctx, line([[left, y], [right, y]]), colours.line, 1);
    ctx.textAlign = "right";
    write(ctx, short(mostY * share), left - 6, y, colours.muted, "11px");
  }
  if (mostX > 1) write(ctx, `${mostX.toLocaleString("en")} ${unit}`, right, height - 7, colours.muted, "11px");
  ctx.textAlign = "left";
  lines.forEach(({ points: own, colour, dash, label }, i) => {
    ctx.setLineDash(dash ?? []);
    stroke(ctx, line(own.map(at)), colours[colour], dash ? 1.25 : 2);
    write(ctx, label, left + 96 * i, 7, colours[colour], "11px");
  });
  ctx.setLineDash([]);
  if (mark) fill(ctx, circle(...at(mark), 4.5), colours.accent);
}
