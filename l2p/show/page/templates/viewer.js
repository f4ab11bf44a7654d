"use strict";
// The 3D view: points with a depth buffer, and lines that add up, written pixel by pixel into a plain 2D canvas.
// Why neither plotly.js nor WebGL: with 30,000 points in a Chromium without a GPU a frame took 5 ms this way, 40 ms
// with WebGL, and 2.6 s with plotly.js, which also makes each page 4.5 MB larger; and a 2D canvas is there where
// WebGL is switched off.
(() => {
const data = JSON.parse(document.getElementById("view-data").textContent);
const find = (id) => document.getElementById(id);
const canvas = find("canvas");
const context = canvas.getContext("2d", { alpha: false, willReadFrequently: true });
const root = document.documentElement;

const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const floats = (text) => text && new Float32Array(bytes(text).buffer);
const clouds = [];
// A number in place of a layer: that of an earlier cloud.
const shared = (cloud, name, read) => typeof cloud[name] === "number" ? clouds[cloud[name]][name] : read(cloud[name]);
for (const cloud of data.clouds) clouds.push({
  ...cloud,
  points: shared(cloud, "points", floats),
  recovered: floats(cloud.recovered),
  lines: shared(cloud, "lines", floats),
  rgb: shared(cloud, "rgb", (text) => text && bytes(text)),
  level: cloud.level && bytes(cloud.level),
  error: cloud.error && bytes(cloud.error),
});
const region = regionOf(data);
const attackers = document.querySelectorAll('input[name="attacker"]').length;

// ---- state ----
const START = { azimuth: -0.96, elevation: 0.5, distance: 2.6, target: [0, 0, 0] };
const NEAR = 0.02, NARROW = 560;
let camera = structuredClone(START);
const checked = (name) => document.querySelector(`input[name="${name}"]:checked`).value;
const SIDES = JSON.parse(canvas.dataset.sides); // The layers that stand side by side, with their headings.
// What is drawn: one layer, or two; a layer of points in a colour of its own, or in the chosen one.
const DRAWN = {
  both: SIDES.map(([layer, heading]) => ({ layer, heading })),
  exposed: [{ layer: "points", mode: "error" }],
  ...Object.fromEntries(["points", "lines", "recovered"].map((layer) => [layer, [{ layer }]])),
};
const state = () => ({
  cloud: clouds[checked("cloud") * attackers + Number(checked("attacker"))],
  layer: checked("layer"),
  color: find("color").value,
  floor: Number(find("floor").value),
  size: Number(find("size").value),
});

// ---- colours: from the style sheet, so that they follow light and dark ----
const named = (name) => {
  const hex = parseInt(getComputedStyle(root).getPropertyValue(`--${name}`).trim().slice(1), 16);
  return [hex >> 16, (hex >> 8) & 255, hex & 255];
};
const mixed = (a, b, share) => a.map((value, i) => value + share * (b[i] - value));
const packed = ([r, g, b]) => ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;
const scale = (...stops) => Uint32Array.from({ length: 256 }, (_, i) => {
  const place = (i / 256) * (stops.length - 1);
  return packed(mixed(stops[Math.floor(place)], stops[Math.floor(place) + 1], place % 1));
});

let colors = null; // of each point of the layer; null for one colour that fades with depth
let background = 0, fading = null, crowding = null;
let painted = []; // for each side, its layer and colours
function paint() {
  painted = DRAWN[state().layer].map((side) => ({ ...side, colors: colorsOf(side.layer, side.mode) }));
}
function colorsOf(layer, own) {
  const { cloud, color } = state();
  const ground = named("canvas"), ink = named("point"), dark = ground[0] < 128;
  background = packed(ground);
  fading = scale(ink, mixed(ink, ground, 0.75));
  crowding = scale(...Array.from({ length: 17 }, (_, i) => mixed(ground, ink, 1 - Math.exp(-i / 4))));
  const places = cloud[layer];
  const mode = own || (layer === "points" ? "rgb" : color);
  if (layer === "lines" || !(mode === "rgb" ? cloud.rgb : mode === "error" ? cloud.error : cloud.level)) return null;
  const values = scale(named("exposed"), named("middle"), named("hidden"));
  return Uint32Array.from({ length: places.length / 3 }, (_, i) => {
    if (mode === "error") return values[cloud.error[i]];
    if (mode === "confidence") return values[Math.round(255 * (1 - cloud.level[i] / data.levels))];
    // Colours of a map are often dark: brighter on a dark ground.
    return packed([0, 1, 2].map((k) => 255 * (cloud.rgb[3 * i + k] / 255) ** (dark ? 0.65 : 1)));
  });
}

// ---- drawing ----
// Width and height of one side; two sides stand beside each other, or, on a narrow page, one above the other.
let width = 0, height = 0, ratio = 1, image, pixels, depth, counts;
function resize(sides) {
  ratio = Math.min(window.devicePixelRatio || 1, 2);
  const whole = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.max(1, Math.round(size * ratio)));
  if (whole[0] !== canvas.width || whole[1] !== canvas.height) [canvas.width, canvas.height] = whole;
  const above = sides > 1 && canvas.clientWidth < NARROW;
  const w = above ? whole[0] : Math.floor(whole[0] / sides), h = above ? Math.floor(whole[1] / sides) : whole[1];
  if (w === width && h === height) return above;
  width = w;
  height = h;
  image = context.createImageData(w, h);
  pixels = new Uint32Array(image.data.buffer);
  depth = new Float32Array(w * h);
  counts = new Uint16Array(w * h);
  return above;
}

// Rows right, up, forward of the camera, and where its own origin lies along them.
function basis() {
  const { azimuth, elevation, distance, target } = camera;
  const ca = Math.cos(azimuth), sa = Math.sin(azimuth), ce = Math.cos(elevation), se = Math.sin(elevation);
  const rows = [[-sa, ca, 0], [-ca * se, -sa * se, ce], [-ca * ce, -sa * ce, -se]];
  const shift = rows.map((row) => -row[0] * target[0] - row[1] * target[1] - row[2] * target[2]);
  shift[2] += distance;
  return { rows, shift, focal: 0.475 * Math.min(width, height) * START.distance };
}

// For each diameter how far the rows of a disc are drawn in.
const discs = Array.from({ length: 41 }, (_, d) => Array.from({ length: d }, (_, row) =>
  Math.round(d / 2 - Math.sqrt(Math.max(0, d * d / 4 - (row + 0.5 - d / 2) ** 2)))));

function drawPoints({ cloud, layer, floor, size }) {
  const { rows: [[a, b, c], [d, e, f], [g, h, i]], shift: [sx, sy, sz], focal } = basis();
  const places = cloud[layer], level = layer === "recovered" && floor ? cloud.level : null;
  // Few points are drawn larger.
  const reach = size * (20000 / cloud.shown) ** 0.2 * ratio * camera.distance;
  depth.fill(Infinity);
  for (let p = 0, o = 0; o < places.length; p++, o += 3) {
    if (level && level[p] < floor) continue;
    const x = places[o], y = places[o + 1], z = places[o + 2], far = g * x + h * y + i * z + sz;
    if (far < NEAR) continue;
    const diameter = Math.min(discs.length - 1, Math.max(1, Math.round(reach / far)));
    const left = Math.round(width / 2 + focal * (a * x + b * y + c * z + sx) / far - diameter / 2);
    const top = Math.round(height / 2 - focal * (d * x + e * y + f * z + sy) / far - diameter / 2);
    if (left + diameter <= 0 || left >= width) continue;
    const color = colors ? colors[p]
      : fading[Math.max(0, Math.min(255, Math.round(128 * (far - camera.distance + 1))))];
    for (let row = Math.max(0, -top); row < diameter && top + row < height; row++) {
      const inset = discs[diameter][row], line = (top + row) * width;
      const end = line + Math.min(width, left + diameter - inset);
      for (let at = line + Math.max(0, left + inset); at < end; at++) {
        if (far < depth[at]) { depth[at] = far; pixels[at] = color; }
      }
    }
  }
}

// The line between two places (at o and o + 3 of a list) in pixels: its start, its change over all steps, the first and
// the last step that are in the picture, and the depths of its ends. Null if it is behind the camera.
function pixelsOf(places, o, { rows, shift, focal }) {
  let [p, q] = [o, o + 3].map((at) => rows.map((row, k) =>
    row[0] * places[at] + row[1] * places[at + 1] + row[2] * places[at + 2] + shift[k]));
  if (p[2] < q[2]) [p, q] = [q, p];
  if (p[2] <= NEAR) return null;
  if (q[2] < NEAR) q = mixed(p, q, (p[2] - NEAR) / (p[2] - q[2]));
  const x = width / 2 + focal * p[0] / p[2], y = height / 2 - focal * p[1] / p[2];
  const dx = width / 2 + focal * q[0] / q[2] - x, dy = height / 2 - focal * q[1] / q[2] - y;
  const steps = Math.ceil(Math.max(Math.abs(dx), Math.abs(dy), 1));
  let from = 0, to = 1;
  for (const [start, change, limit] of [[x, dx, width], [y, dy, height]]) {
    if (!change) { if (start < 0 || start >= limit) to = -1; continue; }
    const ends = [-start / change, (limit - 1 - start) / change];
    from = Math.max(from, Math.min(...ends));
    to = Math.min(to, Math.max(...ends));
  }
  return { x, y, dx, dy, steps, first: Math.ceil(from * steps), last: to * steps, start: p[2], end: q[2] };
}

// Lines are counted in each pixel, and the more there are the stronger its colour.
function drawLines({ cloud: { lines } }) {
  const view = basis();
  counts.fill(0);
  for (let o = 0; o < lines.length; o += 6) {
    const line = pixelsOf(lines, o, view);
    if (!line) continue;
    const { x, y, dx, dy, steps, first, last } = line;
    for (let k = first; k <= last; k++) {
      counts[Math.round(y + dy * k / steps) * width + Math.round(x + dx * k / steps)]++;
    }
  }
  const strength = 26 / Math.max(1, lines.length / 6 / 600);
  for (let at = 0; at < counts.length; at++) {
    if (counts[at]) pixels[at] = crowding[Math.min(255, Math.round(strength * counts[at]))];
  }
}

// The box of the region; its edges are dashed behind points.
function drawBox(edges, layer) {
  const view = basis(), ink = packed(named("ink")), thick = Math.max(1, Math.round(1.5 * ratio));
  for (let o = 0; o < edges.length; o += 6) {
    const line = pixelsOf(edges, o, view);
    if (!line) continue;
    const { x, y, dx, dy, steps, first, last, start, end } = line;
    for (let k = first; k <= last; k++) {
      const share = k / steps, left = Math.round(x + dx * share), top = Math.round(y + dy * share);
      // The inverse of the depth changes evenly along a line in the picture.
      const far = 1 / ((1 - share) / start + share / end);
      if (layer !== "lines" && depth[top * width + left] < far && k % (8 * thick) >= 3 * thick) continue;
      for (let row = top; row < Math.min(height, top + thick); row++) {
        pixels.fill(ink, row * width + left, row * width + Math.min(width, left + thick));
      }
    }
  }
}

let due = false;
function draw() {
  due = false;
  const now = state(), above = resize(painted.length), edges = region.edges();
  // Two sides may leave an odd row or column.
  context.fillStyle = getComputedStyle(root).getPropertyValue("--canvas");
  context.fillRect(0, 0, canvas.width, canvas.height);
  painted.forEach((side, number) => {
    colors = side.colors;
    pixels.fill(background);
    (side.layer === "lines" ? drawLines : drawPoints)({ ...now, layer: side.layer });
    drawBox(edges, side.layer);
    const left = above ? 0 : number * width, top = above ? number * height : 0;
    context.putImageData(image, left, top);
    if (!side.heading) return;
    context.font = `600 ${15 * ratio}px system-ui, sans-serif`;
    context.fillStyle = getComputedStyle(root).getPropertyValue("--ink");
    context.fillText(side.heading, left + 12 * ratio, top + 24 * ratio);
  });
  if (painted.length > 1) {
    context.fillStyle = getComputedStyle(root).getPropertyValue("--grid");
    if (above) context.fillRect(0, height - 1, width, 2 * ratio); else context.fillRect(width - 1, 0, 2 * ratio, height);
  }
}
function redraw() {
  if (!due) requestAnimationFrame(draw);
  due = true;
}

// ---- words ----
const number = (value) => value.toLocaleString("en");
const percent = (part, whole) => `${(100 * part / Math.max(whole, 1)).toFixed(0)}\u00a0%`;
function say() {
  const { cloud, layer, color, floor } = state();
  const top = cloud.kept ? cloud.kept.findLastIndex((kept) => kept > 0) : 0;
  find("floor").max = top;
  const least = Math.min(floor, top);
  find("floor-value").textContent = cloud.calibrated ? percent(least, data.levels) : (least / 100).toFixed(2);
  const back = layer === "recovered" || layer === "both";
  find("floor").disabled = find("color").disabled = !back;
  find("attackers").disabled = !back && layer !== "exposed";
  canvas.classList.toggle("two", layer === "both");
  find("size").disabled = layer === "lines";
  const thinned = cloud.shown < cloud.count ? ` The picture shows ${number(cloud.shown)} of all, drawn at random.` : "";
  let text = `${number(cloud.count)} points.`;
  if (layer === "lines") {
    text = `${number(cloud.count)} lines.`;
    if (cloud.linesTried < cloud.count) text += ` The picture shows ${number(cloud.linesShown)} of them, drawn at random.`;
    else if (cloud.linesShown < cloud.count) text += ` Left out of the picture: ${number(cloud.count - cloud.linesShown)}, far from the others.`;
  } else if (layer === "exposed") {
    text += ` ${number(cloud.right[0])} of these (${percent(cloud.right[0], cloud.count)}) are exposed: they come back within 1 spacing.`;
  } else if (back && cloud.kept) {
    const kept = cloud.kept[least], right = cloud.right && cloud.right[least];
    text = least
      ? `${number(kept)} of ${number(cloud.count)} points (${percent(kept, cloud.count)}) are at least so confident.`
      : `${number(cloud.count)} recovered points.`;
    if (cloud.right && cloud.measured) text += ` ${number(right)} of these (${percent(right, kept)}) are right: within 1 spacing.`;
    if (cloud.right && !cloud.measured) text += ` About ${percent(right, kept)} of these are expected to be within 1 spacing.`;
  }
  if (layer !== "lines") text += thinned;
  find("status").textContent = text;
  const labels = {
    error: ["exposed: in its place", `hidden: ${data.errorLimit} spacings off or more`], confidence: ["sure", "unsure"],
  }[layer === "exposed" ? "error" : color];
  find("legend").hidden = !(back || layer === "exposed") || !labels;
  if (labels) [find("legend-exposed").textContent, find("legend-hidden").textContent] = labels;
  region.say(cloud);
}
function refresh() { say(); paint(); redraw(); }

// ---- hands ----
function turn(dx, dy) {
  camera.azimuth -= dx;
  camera.elevation = Math.max(-1.55, Math.min(1.55, camera.elevation + dy));
  redraw();
}
function move(dx, dy) {
  const { rows: [right, up], focal } = basis();
  const step = ratio * camera.distance / focal;
  camera.target = camera.target.map((value, k) => value - step * (dx * right[k] - dy * up[k]));
  redraw();
}
function zoom(factor) {
  camera.distance = Math.max(0.05, Math.min(30, camera.distance * factor));
  redraw();
}
function reset() { camera = structuredClone(START); redraw(); }

const fingers = new Map();
canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
});
canvas.addEventListener("pointermove", (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const after = [event.clientX, event.clientY], dx = after[0] - before[0], dy = after[1] - before[1];
  const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
  fingers.set(event.pointerId, after);
  if (other) {
    const apart = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]) || 1;
    zoom(apart(before) / apart(after));
    move(dx / 2, dy / 2);
  } else if (event.shiftKey || event.buttons === 2) move(dx, dy);
  else turn(dx * 0.008, dy * 0.008);
});
for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  // The page scrolls until the picture was clicked.
  if (document.activeElement !== canvas && !event.ctrlKey) return;
  event.preventDefault();
  zoom(Math.exp(Math.max(-50, Math.min(50, event.deltaY)) * 0.003));
}, { passive: false });
const ARROWS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const KEYS = {
  ...Object.fromEntries(Object.entries(ARROWS).map(([key, [x, y]]) =>
    [key, (shift) => shift ? move(-30 * x, -30 * y) : turn(0.08 * x, 0.08 * y)])),
  "+": () => zoom(0.85), "=": () => zoom(0.85), "-": () => zoom(1 / 0.85), 0: reset,
};
canvas.addEventListener("keydown", (event) => {
  if (!KEYS[event.key] || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  KEYS[event.key](event.shiftKey);
});
find("closer").addEventListener("click", () => zoom(0.8));
find("farther").addEventListener("click", () => zoom(1.25));
find("reset").addEventListener("click", reset);
for (const input of document.querySelectorAll(".controls input, .controls select")) input.addEventListener("input", refresh);

// Stand here: the server of the page makes the picture of what the camera of the view sees.
if (find("stand")) find("stand").addEventListener("click", () => {
  const { center, radius, axes } = data.stance;
  const { rows: [, up, forward], focal } = basis();
  const turned = (place) => center.map((_, k) => axes.reduce((sum, row, i) => sum + place[i] * row[k], 0));
  const leave = (place) => turned(place).map((value, k) => center[k] + radius * value);
  const eye = camera.target.map((value, k) => value - camera.distance * forward[k]);
  const angle = Math.max(5, Math.min(150, 2 * Math.atan(width / 2 / focal) * 180 / Math.PI));
  const words = { at: leave(eye), toward: leave(camera.target), up: turned(up), angle };
  find("stood-picture").src = `picture?${new URLSearchParams(Object.entries(words).map(([name, value]) => [name, String(value)]))}`;
  find("stood").hidden = false;
});

// Parts of the map, which the sliders of the region show.
for (const button of document.querySelectorAll("button.part")) button.addEventListener("click", () => {
  region.choose(...[button.dataset.low, button.dataset.high].map((corner) => corner.split(" ").map(Number)));
  refresh();
  canvas.scrollIntoView({ block: "center" });
});
addEventListener("theme", ({ detail: atOnce }) => { refresh(); if (atOnce) draw(); });
new ResizeObserver(redraw).observe(canvas);
refresh();
})();
