// A region of the map: a box along its axes, chosen by the sliders of its six sides. Says what is published in it and what
// came back, and the flags of l2p that leave it out.
const regionOf = (data) => {
const find = (id) => document.getElementById(id);
const { center, radius, axes } = data.stance;
const number = (value) => value.toLocaleString("en");
const percent = (part, whole) => `${(100 * part / whole).toFixed(0)}\u00a0%`;

// Coordinates of the view and of the map: docs of l2p.show.stance.Stance.
const enter = (place) => axes.map((row) => row.reduce((sum, value, k) => sum + value * (place[k] - center[k]), 0) / radius);
const leave = (p, q, r) => center.map((value, k) => value + radius * (p * axes[0][k] + q * axes[1][k] + r * axes[2][k]));
const onMap = new WeakMap();
function placesOf(cloud) {
  const drawn = cloud.points || cloud.recovered;
  if (!onMap.has(drawn)) {
    const places = new Float64Array(drawn.length);
    for (let o = 0; o < drawn.length; o += 3) places.set(leave(drawn[o], drawn[o + 1], drawn[o + 2]), o);
    onMap.set(drawn, places);
  }
  return onMap.get(drawn);
}

// The least and the greatest coordinates as the sliders have them, texts; null without a region.
function box() {
  if (!data.sides.length || !find("region").checked) return null;
  const ends = data.sides.map(({ axis }) => [find(`${axis}-from`).value, find(`${axis}-to`).value]
    .sort((one, other) => one - other));
  return [0, 1].map((end) => ends.map((values) => values[end]));
}

// Corners of the twelve edges in coordinates of the view, six numbers each.
function edges() {
  const sides = box()?.map((corner) => corner.map(Number));
  if (!sides) return [];
  const found = [];
  for (let axis = 0; axis < 3; axis++) for (const one of [0, 1]) for (const other of [0, 1]) {
    for (const end of [0, 1]) {
      const ends = [0, 0, 0];
      ends[axis] = end;
      ends[(axis + 1) % 3] = one;
      ends[(axis + 2) % 3] = other;
      found.push(...enter(ends.map((each, k) => sides[each][k])));
    }
  }
  return found;
}

function rowsIn(cloud, [low, high]) {
  const places = placesOf(cloud), least = low.map(Number), most = high.map(Number), rows = [];
  for (let o = 0; o < places.length; o += 3) {
    if ([0, 1, 2].every((k) => places[o + k] >= least[k] && places[o + k] <= most[k])) rows.push(o / 3);
  }
  return rows;
}

// Errors of the recovered points in spacings.
function errorsOf({ points, recovered }, rows) {
  return rows.map((row) => Math.hypot(...[0, 1, 2].map((k) => recovered[3 * row + k] - points[3 * row + k]))
    * radius / data.spacing);
}
function median(values) {
  const ordered = [...values].sort((one, other) => one - other), half = ordered.length >> 1;
  return ordered.length % 2 ? ordered[half] : (ordered[half - 1] + ordered[half]) / 2;
}

function told(cloud, rows) {
  const compared = cloud.points && cloud.recovered && data.spacing;
  const what = compared ? "published points" : cloud.points ? "points" : "recovered points";
  if (!rows.length) return `The box holds none of the ${number(cloud.shown)} ${what}.`;
  const holds = `The box holds ${number(rows.length)} of the ${number(cloud.shown)} ${what} (${percent(rows.length, cloud.shown)}).`;
  if (compared) {
    const errors = errorsOf(cloud, rows), right = errors.filter((error) => error <= 1).length;
    return `${holds} ${number(right)} of these (${percent(right, rows.length)}) came back within 1 spacing; the median error is `
      + `${median(errors).toFixed(2)} spacings.`;
  }
  if (cloud.points || !cloud.level) return holds;
  // The confidence is known to a step of the slider, of which the middle is taken.
  const expected = rows.reduce((sum, row) => sum + Math.min(data.levels, cloud.level[row] + 0.5), 0);
  return `${holds} About ${percent(expected, rows.length * data.levels)} of these are expected to be within 1 spacing.`;
}

function say(cloud) {
  const sides = box(), status = find("region-status"), flags = find("region-flags");
  find("sides").hidden = status.hidden = flags.hidden = !sides;
  if (!sides) return;
  for (const { axis } of data.sides) for (const end of ["from", "to"]) {
    find(`${axis}-${end}-value`).textContent = find(`${axis}-${end}`).value;
  }
  const thinned = cloud.shown < cloud.count ? " Only points that the picture shows are counted." : "";
  status.textContent = told(cloud, rowsIn(cloud, sides)) + thinned;
  flags.querySelector("code").textContent = ["--drop-box", ...sides.flat()].join(" ");
}

// Set the sliders to a box of the map, as far as they reach, and a step wider, so that its points are in it.
function choose(low, high) {
  find("region").checked = true;
  data.sides.forEach(({ axis }, k) => {
    const step = Number(find(`${axis}-from`).step);
    find(`${axis}-from`).value = low[k] - step;
    find(`${axis}-to`).value = high[k] + step;
  });
}
return { edges, say, choose };
};
