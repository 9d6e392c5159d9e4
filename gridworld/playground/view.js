// Drawing: the board and the curve, on canvases whose colours are the page's.

import { MOVES } from "./world.js";

const VIRIDIS = ["440154", "482878", "3e4a89", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725"];
const ORANGES = ["fff7ec", "fee8c8", "fdd49e", "fdbb84", "fc8d59", "ef6548", "d7301f", "b30000", "7f0000"];
const parts = palette => palette.map(hex => [0, 2, 4].map(at => parseInt(hex.slice(at, at + 2), 16)));
const PALETTES = { viridis: parts(VIRIDIS), oranges: parts(ORANGES) };

export const gradient = name => `linear-gradient(90deg, ${PALETTES[name].map(rgb => `rgb(${rgb})`).join(", ")})`;

/** A palette's colour for t from 0 to 1, and the ink that is legible on it. */
function shade(name, t) {
  const palette = PALETTES[name], x = Math.min(Math.max(t || 0, 0), 1) * (palette.length - 1), i = Math.min(Math.floor(x), palette.length - 2);
  const rgb = palette[i].map((from, c) => Math.round(from + (x - i) * (palette[i + 1][c] - from)));
  return { fill: `rgb(${rgb})`, ink: 0.3 * rgb[0] + 0.59 * rgb[1] + 0.11 * rgb[2] > 140 ? "#111" : "#fff" };
}

/** A number in four digits. */
export const precise = x => (Number.isFinite(x) ? String(Number(x.toPrecision(4))).replace("-", "−") : short(x));

/** A number in two or three digits. */
export function short(x) {
  if (Number.isNaN(x)) return "–";
  if (!Number.isFinite(x)) return x > 0 ? "∞" : "−∞";
  const size = Math.abs(x), text = size >= 1e5 || (size > 0 && size < 5e-3) ? x.toExponential(0) : x.toFixed(size >= 100 ? 0 : size >= 10 ? 1 : 2);
  return text.replace("-", "−");
}

function theme() {
  const style = getComputedStyle(document.documentElement), names = ["ink", "muted", "line", "accent", "on", "wall", "cell", "wrong", "good", "goal", "trap"];
  return Object.fromEntries(names.map(name => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** A context for a canvas in its size on the page, in CSS pixels. */
function context(canvas) {
  const ratio = window.devicePixelRatio || 1, { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, width, height);
  return { ctx, width, height };
}

function polygon(ctx, points, fill) {
  ctx.beginPath();
  points.forEach(([x, y]) => ctx.lineTo(x, y));
  ctx.closePath();
  ctx.fillStyle = fill;
  ctx.fill();
}

/** An arrow through the middle of a cell, or of several a slimmer one from there. */
function arrow(ctx, x, y, action, c, ink, isOne) {
  const [down, right] = MOVES[action], at = (along, across) => [x + c * (right * along - down * across), y + c * (down * along + right * across)];
  const [from, neck, tip, thin, wide] = isOne ? [-0.26, 0.06, 0.27, 0.045, 0.14] : [0, 0.15, 0.3, 0.03, 0.1];
  polygon(ctx, [at(from, -thin), at(neck, -thin), at(neck, -wide), at(tip, 0), at(neck, wide), at(neck, thin), at(from, thin)], ink);
}

/**
 * Draw a map. `scene` has the map, and by state or by state and action what is to be seen: `fill` {palette, of(s): t or
 * null}, `quarter` {palette, of(pair): t, texts(pair): lines} or null, `number(s)`, `arrows(s)`: actions, `wrong(s)`, and
 * `path`: states, `agent`: a state or -1.
 */
export function drawBoard(canvas, scene) {
  const { ctx, width } = context(canvas), colours = theme(), { map } = scene, c = width / map.cols;
  ctx.textAlign = "center";
  ctx.textBaseline = "middle";
  const round = c >= 20 ? Math.min(5, c * 0.07) : 0, gap = c >= 12 ? 1 : 0.25;
  const box = (s, inset) => {
    const x = (s % map.cols) * c + inset, y = Math.floor(s / map.cols) * c + inset;
    ctx.beginPath();
    ctx.roundRect(x, y, c - 2 * inset, c - 2 * inset, round);
  };
  const centre = s => [(s % map.cols + 0.5) * c, (Math.floor(s / map.cols) + 0.5) * c];
  const font = (size, weight = 600) => (ctx.font = `${weight} ${size}px system-ui, "Liberation Sans", sans-serif`);
  const hasNumber = c >= 42 && !scene.quarter, lift = hasNumber ? 0.09 * c : 0, inks = [];
  for (let s = 0; s < map.tiles.length; s++) {
    const tile = map.tiles[s], [x, y] = centre(s), t = "#GTC".includes(tile) ? null : scene.fill.of(s);
    const { fill, ink } = t === null ? { fill: tile === "#" ? colours.wall : colours.cell, ink: colours.ink } : shade(scene.fill.palette, t);
    inks.push(ink);
    box(s, gap);
    ctx.fillStyle = fill;
    ctx.fill();
    if (tile === "G") polygon(ctx, [[x, y - 0.3 * c], [x + 0.3 * c, y + 0.28 * c], [x - 0.3 * c, y + 0.28 * c]], colours.goal);
    if (tile === "T") ctx.beginPath(), ctx.arc(x, y, c / 3.2, 0, 7), (ctx.fillStyle = colours.trap), ctx.fill();
    if (tile === "C") {
      ctx.save();
      ctx.clip();
      ctx.strokeStyle = colours.trap;
      ctx.lineWidth = c * 0.1;
      for (let i = -1; i <= 1; i += 0.5) ctx.beginPath(), ctx.moveTo(x + (i - 0.5) * c, y + 0.5 * c), ctx.lineTo(x + (i + 0.5) * c, y - 0.5 * c), ctx.stroke();
      ctx.restore();
    }
    if (scene.quarter && !"#GTC".includes(tile)) quarters(ctx, scene, s, x, y, c / 2 - gap, font);
  }
  ctx.lineJoin = ctx.lineCap = "round";
  for (const [colour, thick] of [["rgba(255,255,255,.8)", 0.1], ["#6464dc", 0.055]]) {
    ctx.beginPath();
    if (!scene.quarter) scene.path.forEach(s => ctx.lineTo(centre(s)[0], centre(s)[1] - lift));
    ctx.strokeStyle = colour;
    ctx.lineWidth = Math.max(1.5, c * thick);
    ctx.stroke();
  }
  for (let s = 0; s < map.tiles.length; s++) {
    if ("#GTC".includes(map.tiles[s])) continue;
    const [x, y] = centre(s), actions = scene.quarter && c >= 54 ? [] : scene.arrows(s);
    if (map.tiles[s] === "S" && !scene.quarter) ctx.beginPath(), ctx.arc(x, y - lift, c * 0.36, 0, 7), (ctx.strokeStyle = "#fff"), (ctx.lineWidth = c * 0.06), ctx.stroke(), (ctx.strokeStyle = "#6464dc"), (ctx.lineWidth = c * 0.035), ctx.stroke();
    for (const action of actions) arrow(ctx, x, y - lift, action, c, scene.quarter ? "#fff" : inks[s], actions.length === 1);
    if (hasNumber) font(Math.min(15, c * 0.2)), (ctx.fillStyle = inks[s]), ctx.fillText(scene.number(s), x, y + 0.35 * c, c * 0.92);
    if (!scene.wrong(s)) continue;
    ctx.strokeStyle = colours.wrong;
    ctx.lineWidth = Math.max(1.5, c * 0.05);
    box(s, gap + ctx.lineWidth / 2);
    ctx.stroke();
  }
  if (scene.agent >= 0) {
    const [x, y] = centre(scene.agent), half = 0.27 * c;
    ctx.beginPath();
    ctx.roundRect(x - half, y - half, 2 * half, 2 * half, half * 0.35);
    ctx.fillStyle = "rgb(100, 100, 220)";
    ctx.strokeStyle = "#fff";
    ctx.lineWidth = Math.max(1, c * 0.04);
    ctx.fill();
    ctx.stroke();
  }
  if (scene.selected >= 0) {
    box(scene.selected, 1.5);
    ctx.strokeStyle = colours.accent;
    ctx.lineWidth = 3;
    ctx.stroke();
  }
}

/** A cell's four actions as four triangles with what each is worth. */
function quarters(ctx, scene, s, x, y, half, font) {
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([right, down]) => [x + right * half, y + down * half]);
  MOVES.forEach(([down, right], a) => {
    const { fill, ink } = shade(scene.quarter.palette, scene.quarter.of(s * 4 + a)), lines = half >= 27 ? scene.quarter.texts(s * 4 + a) : [];
    polygon(ctx, [corners[a], corners[(a + 1) % 4], [x, y]], fill);
    const two = lines.length > 1 && half >= 44, size = Math.min(14, half * 0.28), far = half * (right ? 0.64 : two ? 0.66 : 0.7);
    ctx.fillStyle = ink;
    (two ? lines : lines.slice(0, 1)).forEach((line, i) => {
      font(i ? size * 0.82 : size, i ? 400 : 640);
      ctx.fillText(line, x + right * far, y + down * far + (two ? (i - 0.5) * size * 1.05 : 0), half * (right ? 0.66 : 1));
    });
  });
  ctx.strokeStyle = "rgba(255,255,255,.5)";
  ctx.lineWidth = 1;
  for (const i of [0, 1]) ctx.beginPath(), ctx.moveTo(...corners[i]), ctx.lineTo(...corners[i + 2]), ctx.stroke();
}

/** Draw lines {points: [[x, y]], colour: a name of the theme, dash, label}; y from 0 up, infinite y at the top. */
export function drawCurve(canvas, lines, unit, mark) {
  const { ctx, width, height } = context(canvas), colours = theme(), left = 44, bottom = height - 20, top = 8;
  const points = lines.flatMap(line => line.points), ys = points.map(point => point[1]).filter(Number.isFinite);
  const mostX = points.reduce((most, [x]) => Math.max(most, x), 1), mostY = ys.reduce((most, y) => Math.max(most, y), 0) || 1;
  const at = ([x, y]) => [left + (x / mostX) * (width - left - 8), bottom - (Math.min(Math.max(y, 0), mostY * 1.04) / (mostY * 1.04)) * (bottom - top)];
  ctx.font = '11px system-ui, "Liberation Sans", sans-serif';
  ctx.fillStyle = colours.muted;
  ctx.strokeStyle = colours.line;
  ctx.textBaseline = "middle";
  for (const share of [0, 0.5, 1]) {
    const y = at([0, mostY * share])[1];
    ctx.beginPath(), ctx.moveTo(left, y), ctx.lineTo(width - 8, y), ctx.stroke();
    ctx.textAlign = "right";
    ctx.fillText(short(mostY * share), left - 6, y);
  }
  ctx.fillText(`${mostX.toLocaleString("en")} ${unit}`, width - 8, height - 7);
  for (const line of lines) {
    ctx.beginPath();
    line.points.forEach(point => ctx.lineTo(...at(point)));
    ctx.strokeStyle = colours[line.colour];
    ctx.setLineDash(line.dash ?? []);
    ctx.lineWidth = line.dash ? 1.25 : 2;
    ctx.stroke();
  }
  ctx.setLineDash([]);
  ctx.textAlign = "left";
  lines.filter(line => line.label).forEach((line, i) => {
    ctx.fillStyle = colours[line.colour];
    ctx.fillText(line.label, left + 96 * i, height - 7);
  });
  if (mark) ctx.beginPath(), ctx.arc(...at(mark), 4.5, 0, 7), (ctx.fillStyle = colours.accent), ctx.fill();
}
