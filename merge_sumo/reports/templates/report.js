"use strict";
// Everything that is drawn comes from the JSON in #data; text is set as text, never as markup.
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const namespace = document.querySelector("svg").namespaceURI;
const DT = data.dt, CRASH = data.crash_m, RADIUS = data.radius;
const dims = data.dimensions; // x, v, psi: [low, high]
const cases = data.cases;
const place = new Map(cases.index.map((index, i) => [index, i]));

function draw(parent, tag, attributes = {}, text = null) {
  const node = document.createElementNS(namespace, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text !== null) node.textContent = text;
  parent.append(node);
  return node;
}
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const fixed = (value, digits) => value.toFixed(digits).replace("-", "\u2212");
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const path = (points) => points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(2)} ${y.toFixed(2)}`).join("");

/* ---------- cases ---------- */
const speedBytes = bytes(data.speeds);
const speeds = new DataView(speedBytes.buffer);
const speedAt = (k) => speeds.getUint16(2 * k, true) * data.speed_unit_mps;

function motion(i) {
  // Speeds are kept; positions follow by x' = x + v dt, as the vehicles moved.
  const rows = cases.rows[i];
  if (!rows) return null;
  const first = cases.offset[i];
  const vPov = [], vVut = [], xPov = [cases.x[i]], xVut = [data.x_vut0_m];
  for (let t = 0; t < rows; t++) {
    vPov.push(speedAt(2 * (first + t)));
    vVut.push(speedAt(2 * (first + t) + 1));
  }
  for (let t = 1; t < rows; t++) {
    xPov.push(xPov[t - 1] + vPov[t - 1] * DT);
    xVut.push(xVut[t - 1] + vVut[t - 1] * DT);
  }
  return { rows, vPov, vVut, xPov, xVut };
}
const failed = (i) => cases.failed[i] === 1;
const tested = (i) => ["MERGED", "COLLISION"].includes(data.ends[cases.end[i]]);
const psiText = (psi) => `${fixed(psi, 2)} rad`;

function title(i) {
  const psi = cases.psi[i];
  return `Case ${cases.index[i]} · POV level ${data.level_names[cases.level[i]]}, x_POV0 ${fixed(cases.x[i], 1)} m, v_POV0 ${fixed(cases.v[i], 2)} m/s` +
    (psi === null ? "" : `, psi ${psiText(psi)}`);
}
function words(i) {
  const end = data.ends[cases.end[i]], parts = [];
  const vut = cases.vut_yields[i], pov = cases.pov_yields[i];
  const yields = [[vut, "VUT"], [pov, "POV"]].filter(([t]) => t !== null).sort((a, b) => a[0] - b[0]);
  if (end === "COLLISION") {
    const kind = cases.kind[i] === null ? "" : ` (${data.kinds[cases.kind[i]]})`;
    parts.push(`Collision${kind} at ${fixed(cases.t_end[i], 1)} s: gap ${fixed(cases.dx[i], 1)} m, difference in speed ${fixed(Math.abs(cases.dv[i]), 1)} m/s.`);
  } else if (end === "MERGED") {
    parts.push(`No collision: the ${cases.dx[i] < 0 ? "VUT" : "POV"} goes first, gap ${fixed(cases.dx[i], 1)} m when the VUT arrives.`);
  } else if (end === "TIMEOUT") {
    parts.push(`Timeout: the VUT did not arrive in ${fixed(cases.t_end[i], 0)} s.`);
  } else {
    parts.push(`${end}: ${data.errors[cases.index[i]] || "no reason given"}`);
  }
  if (yields.length) {
    parts.push(yields.map(([t, who], n) => `${n ? "the" : "The"} ${who} begins to yield at ${fixed(t, 1)} s`).join(", ") + ".");
  } else if (cases.rows[i]) parts.push("Neither yields.");
  if (end === "COLLISION") {
    const until = cases.way_out[i];
    parts.push(until === null ? "There never was a way out for the VUT." : `Full braking or full acceleration of the VUT would have avoided it until ${fixed(until, 1)} s.`);
  }
  return parts.join(" ");
}

/* ---------- grids: the surrogate's chance, the truth's outline ---------- */
function slice(grid, level, psi) {
  if (!grid.values) grid.values = bytes(grid.data);
  const { nx, ny, np, values } = grid, size = nx * ny;
  if (level !== 2) return values;
  const out = new Float32Array(size);
  if (psi === null) { // all at once: the highest over psi
    for (let k = 0; k < np; k++) for (let n = 0; n < size; n++) out[n] = Math.max(out[n], values[k * size + n]);
    return out;
  }
  const at = clamp((psi - dims.psi[0]) / (dims.psi[1] - dims.psi[0]), 0, 1) * (np - 1);
  const low = Math.min(Math.floor(at), np - 2), share = at - low;
  for (let n = 0; n < size; n++) out[n] = (1 - share) * values[low * size + n] + share * values[(low + 1) * size + n];
  return out;
}
function contour(values, nx, ny, level, X, Y) {
  // Marching squares; the two ambiguous squares are cut as two corners.
  let d = "";
  const cut = (a, b) => (level - a) / (b - a);
  for (let j = 0; j + 1 < ny; j++) for (let i = 0; i + 1 < nx; i++) {
    const a = values[j * nx + i], b = values[j * nx + i + 1], c = values[(j + 1) * nx + i + 1], e = values[(j + 1) * nx + i];
    const code = (a > level) | ((b > level) << 1) | ((c > level) << 2) | ((e > level) << 3);
    if (code === 0 || code === 15) continue;
    const south = () => [i + cut(a, b), j], north = () => [i + cut(e, c), j + 1];
    const west = () => [i, j + cut(a, e)], east = () => [i + 1, j + cut(b, c)];
    const lines = {
      1: [[west, south]], 2: [[south, east]], 3: [[west, east]], 4: [[east, north]], 5: [[west, south], [east, north]],
      6: [[south, north]], 7: [[west, north]],
    }[code > 7 ? 15 - code : code];
    const pairs = code === 10 ? [[south, east], [west, north]] : lines;
    for (const [from, to] of pairs) d += path([from(), to()].map(([x, y]) => [X(x / (nx - 1)), Y(y / (ny - 1))]));
  }
  return d;
}
function shade(svg, values, nx, ny, box) {
  const canvas = document.createElement("canvas");
  canvas.width = nx; canvas.height = ny;
  const context = canvas.getContext("2d"), image = context.createImageData(nx, ny);
  for (let j = 0; j < ny; j++) for (let i = 0; i < nx; i++) {
    const at = 4 * ((ny - 1 - j) * nx + i);
    image.data.set([213, 94, 0, Math.round(0.55 * values[j * nx + i])], at);
  }
  context.putImageData(image, 0, 0);
  const [x, y, w, h] = box, dx = w / (nx - 1), dy = h / (ny - 1);
  draw(svg, "image", { href: canvas.toDataURL(), x: x - dx / 2, y: y - dy / 2, width: w + dx, height: h + dy, preserveAspectRatio: "none", "clip-path": "url(#clip)" });
}

/* ---------- maps ---------- */
const BOX = [44, 8, 346, 286]; // x, y, width, height of the plot in a map
const PSI_NEAR = 0.1; // rad: cases this near to the slider are shown in full
let psi = 0, psiAll = false, chosen = -1;
const maps = [...document.querySelectorAll(".map")].map((figure) => new FailureMap(figure));

function FailureMap(figure) {
  const svg = figure.querySelector("svg"), level = Number(figure.dataset.level);
  const [left, top, width, height] = BOX;
  const X = (u) => left + u * width, Y = (u) => top + (1 - u) * height;
  const unit = (value, [low, high]) => (value - low) / (high - low);
  const marks = cases.index.map((_, i) => i).filter((i) => cases.level[i] === level)
    .map((i) => ({ i, x: X(unit(cases.x[i], dims.x)), y: Y(unit(cases.v[i], dims.v)) }))
    .sort((a, b) => failed(a.i) - failed(b.i));
  const apart = (i) => (level === 2 && !psiAll ? Math.abs(cases.psi[i] - psi) : 0);

  this.level = level;
  this.draw = () => {
    svg.replaceChildren();
    const clip = draw(draw(svg, "defs"), "clipPath", { id: "clip" });
    draw(clip, "rect", { x: left, y: top, width, height });
    const at = level === 2 && psiAll ? null : psi;
    if (data.chance[level]) { const g = data.chance[level]; shade(svg, slice(g, level, at), g.nx, g.ny, BOX); }
    for (const [name, range, step] of [["x", dims.x, 40], ["v", dims.v, 2]]) {
      for (let value = Math.ceil(range[0] / step) * step; value <= range[1] + 1e-9; value += step) {
        const u = unit(value, range), vertical = name === "x";
        draw(svg, "line", vertical ? { class: "grid", x1: X(u), x2: X(u), y1: top, y2: top + height } : { class: "grid", x1: left, x2: left + width, y1: Y(u), y2: Y(u) });
        draw(svg, "text", vertical ? { x: X(u), y: top + height + 15, "text-anchor": "middle" } : { x: left - 6, y: Y(u) + 4, "text-anchor": "end" }, fixed(value, 0));
      }
    }
    draw(svg, "text", { x: left + width / 2, y: top + height + 32, "text-anchor": "middle" }, "x_POV0, m");
    draw(svg, "text", { transform: `translate(12 ${top + height / 2}) rotate(-90)`, "text-anchor": "middle" }, "v_POV0, m/s");
    counts();
    const balls = draw(svg, "g", { class: "balls", "clip-path": "url(#clip)" });
    for (const { i, x, y } of marks) if (failed(i)) {
      const off = apart(i) / (dims.psi[1] - dims.psi[0]);
      if (off >= RADIUS) continue;
      const r = Math.sqrt(RADIUS ** 2 - off ** 2); // the slice of the ball at this psi
      draw(balls, "ellipse", { cx: x, cy: y, rx: r * width, ry: r * height });
    }
    if (data.truth[level]) {
      const g = data.truth[level], values = slice(g, level, at);
      draw(svg, "path", { class: "outline", d: contour(values, g.nx, g.ny, 127.5, X, Y) });
    }
    draw(svg, "rect", { class: "frame", x: left, y: top, width, height });
    for (const { i, x, y } of marks) {
      const faint = apart(i) > PSI_NEAR ? " faint" : "";
      if (failed(i)) draw(svg, "path", { class: `mark fail${faint}`, d: `M${x} ${y - 5}l5 5l-5 5l-5 -5Z`, "data-case": cases.index[i] });
      else if (!tested(i)) draw(svg, "rect", { class: `mark error${faint}`, x: x - 3, y: y - 3, width: 6, height: 6, "data-case": cases.index[i] });
      else draw(svg, "circle", { class: `mark safe${faint}`, cx: x, cy: y, r: 2.4, "data-case": cases.index[i] });
    }
    this.choose();
  };
  const counts = () => { // of a long campaign: the cases that are not listed one by one
    const grid = data.counts[level];
    if (!grid) return;
    const most = Math.max(...grid.safe, ...grid.failing, 1);
    for (let n = 0; n < grid.nx * grid.ny; n++) {
      const x = X((n % grid.nx) / grid.nx), y = Y((Math.floor(n / grid.nx) + 1) / grid.ny);
      for (const [name, count] of [["count", grid.safe[n]], ["count failing", grid.failing[n]]]) if (count) {
        draw(svg, "rect", { class: name, x, y, width: width / grid.nx, height: height / grid.ny, "fill-opacity": (0.08 + 0.5 * count / most).toFixed(3) });
      }
    }
  };
  this.choose = () => {
    svg.querySelector(".chosen")?.remove();
    const mark = marks.find((m) => m.i === chosen);
    if (mark) draw(svg, "circle", { class: "chosen", cx: mark.x, cy: mark.y, r: 8 });
  };
  const visible = () => marks.filter((m) => apart(m.i) <= PSI_NEAR);
  const at = (event) => {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    let best = null, near = 14;
    for (const mark of visible()) {
      const distance = Math.hypot(mark.x - point.x, mark.y - point.y) - (failed(mark.i) ? 3 : 0);
      if (distance < near) [best, near] = [mark, distance];
    }
    return best;
  };
  svg.addEventListener("click", (event) => { const mark = at(event); if (mark) show(mark.i); });
  svg.addEventListener("pointermove", (event) => { const mark = at(event); mark ? tip(event, title(mark.i)) : tip(null); });
  svg.addEventListener("pointerleave", () => tip(null));
  svg.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!way) return;
    event.preventDefault();
    const here = marks.find((m) => m.i === chosen);
    const near = visible();
    if (!here) { if (near.length) show(near[near.length - 1].i); return; }
    let best = null, least = Infinity;
    for (const mark of near) {
      const dx = mark.x - here.x, dy = mark.y - here.y;
      const along = dx * way[0] + dy * way[1], aside = Math.abs(dx * way[1]) + Math.abs(dy * way[0]);
      if (along > 0.01 && along + 3 * aside < least) [best, least] = [mark, along + 3 * aside];
    }
    if (best) show(best.i);
  });
}
const tipBox = document.createElement("div");
tipBox.className = "tip"; tipBox.hidden = true;
document.body.append(tipBox);
function tip(event, text) {
  tipBox.hidden = event === null;
  if (!event) return;
  tipBox.textContent = text;
  tipBox.style.left = `${Math.max(4, Math.min(event.pageX + 12, document.documentElement.clientWidth - tipBox.offsetWidth - 8))}px`;
  tipBox.style.top = `${event.pageY + 14}px`;
}
function setPsi(value, all) {
  psi = value; psiAll = all;
  const slider = byId("psi");
  slider.value = value;
  slider.disabled = all;
  byId("psi-all").checked = all;
  byId("psi-value").textContent = all ? "all values" : `${psiText(psi)} (${Math.round(psi * 180 / Math.PI)}°)`;
  for (const map of maps) if (map.level === 2) map.draw();
}

/* ---------- plots over time ---------- */
function plot(svg, { xRange, yRange, xLabel, lines, bars = [], bands = [], flags = [], xTicks = 4, digits = null }) {
  const [, , w, h] = svg.getAttribute("viewBox").split(" ").map(Number);
  const left = 40, right = w - 8, top = 8, bottom = h - 28;
  const X = (x) => left + (x - xRange[0]) / (xRange[1] - xRange[0] || 1) * (right - left);
  const Y = (y) => bottom - (y - yRange[0]) / (yRange[1] - yRange[0] || 1) * (bottom - top);
  svg.replaceChildren();
  for (const [low, high] of bands) {
    const [a, b] = [Y(clamp(high, ...yRange)), Y(clamp(low, ...yRange))];
    draw(svg, "rect", { class: "danger", x: left, y: a, width: right - left, height: b - a });
  }
  const step = nice((yRange[1] - yRange[0]) / 5);
  for (let y = Math.ceil(yRange[0] / step) * step; y <= yRange[1] + 1e-12; y += step) {
    draw(svg, "line", { class: "grid", x1: left, x2: right, y1: Y(y), y2: Y(y) });
    draw(svg, "text", { x: left - 5, y: Y(y) + 4, "text-anchor": "end" }, fixed(Math.abs(y) < step / 1e6 ? 0 : y, digits ?? Math.max(0, -Math.floor(Math.log10(step) + 1e-9))));
  }
  const xStep = Math.max(1, nice((xRange[1] - xRange[0]) / xTicks));
  for (let x = Math.ceil(xRange[0] / xStep) * xStep; x <= xRange[1] + 1e-9; x += xStep) {
    draw(svg, "text", { x: X(x), y: bottom + 13, "text-anchor": "middle" }, fixed(x, 0));
  }
  draw(svg, "text", { x: right, y: h - 3, "text-anchor": "end" }, xLabel);
  for (const { name, x0, x1, y0, y1 } of bars) draw(svg, "rect", { class: name, x: X(x0), width: Math.max(X(x1) - X(x0) - 0.6, 0.4), y: Y(y1), height: Y(y0) - Y(y1) });
  for (const { name, points } of lines) {
    draw(svg, "path", { class: `line ${name}`, d: path(points.map(([x, y]) => [X(x), Y(clamp(y, ...yRange))])) });
    if (points.length === 1) draw(svg, "circle", { class: name, cx: X(points[0][0]), cy: Y(points[0][1]), r: 2 });
  }
  for (const { name, x, y } of flags) draw(svg, "path", { class: name, d: `M${X(x)} ${Y(y) - 2}l-4.5 -7h9Z` });
  return { X, now: draw(svg, "line", { class: "now", x1: -9, x2: -9, y1: top, y2: bottom }), from: left, to: right };
}
function nice(step) {
  if (!(step > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(step));
  return power * [1, 2, 5, 10].find((f) => f * power >= step);
}
function range(values, pad = 0.06) {
  const low = Math.min(...values), high = Math.max(...values), more = pad * (high - low) || 1;
  return [low - more, high + more];
}

/* ---------- a case: road, motion, charts ---------- */
const road = byId("road"), slider = byId("time");
let moving = null, step = 0, playing = false, last = 0, charts = [];

function show(i, scroll = false) {
  chosen = i;
  if (cases.psi[i] !== null && !psiAll && Math.abs(cases.psi[i] - psi) > PSI_NEAR) setPsi(cases.psi[i], false);
  byId("case-title").textContent = title(i);
  byId("case-words").textContent = words(i);
  byId("command").textContent = data.commands[cases.index[i]] || `${data.export} ${cases.index[i]} && ${data.replay.replace("NNNNN", String(cases.index[i]).padStart(5, "0"))}`;
  for (const part of document.querySelectorAll(".command, .command-title")) part.hidden = false;
  for (const map of maps) map.choose();
  for (const button of document.querySelectorAll("[data-case]")) {
    button.closest("tr")?.classList.toggle("on", Number(button.dataset.case) === cases.index[i]);
  }
  moving = motion(i);
  byId("case-motion").hidden = moving === null;
  play(false);
  if (moving) showMotion(i);
  if (scroll) byId("case").scrollIntoView({ block: "nearest" });
}
function showMotion(i) {
  const { rows, vPov, vVut, xPov, xVut } = moving, end = (rows - 1) * DT;
  const over = (values) => values.map((value, t) => [t * DT, value]);
  const gap = xPov.map((x, t) => x - xVut[t]);
  const flags = (pov, vut) => [["pov", cases.pov_yields[i], pov], ["vut", cases.vut_yields[i], vut]]
    .filter(([, t]) => t !== null).map(([name, t, values]) => ({ name, x: t, y: values[Math.round(t / DT)] }));
  const common = { xRange: [0, end], xLabel: "time, s" };
  charts = [
    plot(byId("chart-speed"), { ...common, yRange: range([...vPov, ...vVut], 0.14), lines: [{ name: "pov", points: over(vPov) }, { name: "vut", points: over(vVut) }], flags: flags(vPov, vVut) }),
    plot(byId("chart-position"), { ...common, yRange: range([...xPov, ...xVut]), lines: [{ name: "pov", points: over(xPov) }, { name: "vut", points: over(xVut) }] }),
    plot(byId("chart-gap"), { ...common, yRange: range([...gap, -12, 12]), lines: [{ name: "gap", points: over(gap) }], bands: [[-CRASH, CRASH]] }),
  ];
  slider.max = rows - 1;
  drawRoad();
  at(failed(i) ? rows - 1 : 0);
}
let cars = {};
function drawRoad() {
  road.replaceChildren();
  // A lane is 3.2 m wide: what is left free between two lanes is the line between them.
  for (const lane of data.lanes) draw(road, "path", { class: "lane", d: path(lane.map(([x, y]) => [x, -y])), "stroke-width": 3.05 });
  draw(road, "line", { class: "merge", x1: 0, x2: 0, y1: -5.4, y2: 2.4, "stroke-width": 0.25 });
  cars = {};
  for (const who of ["pov", "vut"]) {
    const group = draw(road, "g");
    draw(group, "rect", { class: who, x: -5, y: -1, width: 5, height: 2, rx: 0.6 });
    const brake = draw(group, "rect", { class: "brake", x: -5.3, y: -1, width: 0.6, height: 2 });
    const label = draw(road, "text", { "text-anchor": "middle" }, who.toUpperCase());
    cars[who] = { group, brake, label };
  }
}
function pose(path, along) { // front bumper at a lane coordinate of a path
  let k = path.findIndex(([at], i) => i > 0 && along < at);
  if (k < 0) k = path.length - 1;
  // Where a lane begins its point stands twice, and some lanes are as short as a point.
  while (k > 1 && path[k][0] === path[k - 1][0]) k--;
  const [[s0, x0, y0], [s1, x1, y1]] = [path[k - 1], path[k]], share = (along - s0) / (s1 - s0 || 1);
  return { x: x0 + share * (x1 - x0), y: y0 + share * (y1 - y0), angle: Math.atan2(y0 - y1, x1 - x0) * 180 / Math.PI };
}
function at(t) {
  if (!moving) return;
  step = clamp(t, 0, moving.rows - 1);
  const k = Math.min(Math.floor(step), Math.max(moving.rows - 2, 0)), share = step - k, next = Math.min(k + 1, moving.rows - 1);
  const mix = (values) => (1 - share) * values[k] + share * values[next];
  const places = { pov: pose(data.main, mix(moving.xPov)), vut: pose(data.ramp, mix(moving.xVut)) };
  const low = Math.min(places.pov.x, places.vut.x), high = Math.max(places.pov.x, places.vut.x);
  const apart = Math.abs(places.pov.y - places.vut.y), upper = places.pov.y >= places.vut.y ? "pov" : "vut";
  // The view follows both, never closer than 90 m; cars keep a size that can be seen.
  const ratio = road.clientHeight / (road.clientWidth || 1) || 0.25;
  const width = Math.max(high - low + 50, (1.7 * apart + 22) / ratio, 90), middle = (low + high) / 2;
  const size = Math.max(1, width / 90), height = width * ratio;
  const centre = -(Math.min(places.pov.y, places.vut.y) + Math.max(places.pov.y, places.vut.y)) / 2;
  road.setAttribute("viewBox", `${middle - width / 2} ${centre - height / 2} ${width} ${height}`);
  for (const [who, v] of [["pov", moving.vPov], ["vut", moving.vVut]]) {
    const { x, y, angle } = places[who], a = (v[next] - v[k]) / DT;
    cars[who].group.setAttribute("transform", `translate(${x} ${-y}) rotate(${angle}) scale(${Math.min(size, 2.2)})`);
    cars[who].brake.setAttribute("visibility", a < -0.2 ? "visible" : "hidden");
    const label = cars[who].label, side = who === upper ? -1 : 1;
    label.setAttribute("x", x - 2.5); label.setAttribute("y", -y + side * (side < 0 ? 6.4 : 5.4) * Math.min(size, 2));
    label.style.fontSize = `${2.6 * size}px`;
    label.textContent = `${who.toUpperCase()} ${fixed(mix(v), 1)} m/s`;
  }
  slider.value = Math.round(step);
  slider.setAttribute("aria-valuetext", `${fixed(step * DT, 1)} seconds`);
  byId("time-value").textContent = `${fixed(step * DT, 1)} s`;
  for (const { X, now } of charts) { now.setAttribute("x1", X(step * DT)); now.setAttribute("x2", X(step * DT)); }
}
function play(on) {
  playing = on && moving !== null;
  const button = byId("play");
  button.textContent = playing ? "❚❚" : "▶";
  button.setAttribute("aria-label", playing ? "Pause" : "Play");
  if (!playing) return;
  if (step >= moving.rows - 1) at(0);
  last = performance.now();
  requestAnimationFrame(frame);
}
function frame(now) {
  if (!playing) return;
  at(step + (now - last) / 1000 / DT * Number(byId("rate").value));
  last = now;
  step >= moving.rows - 1 ? play(false) : requestAnimationFrame(frame);
}
slider.addEventListener("input", () => { play(false); at(Number(slider.value)); });
byId("play").addEventListener("click", () => play(!playing));
byId("case").addEventListener("keydown", (event) => {
  if (event.key === " " && event.target === slider) { event.preventDefault(); play(!playing); }
});
for (const id of ["chart-speed", "chart-position", "chart-gap"]) {
  const svg = byId(id);
  const scrub = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    play(false);
    at((point.x - charts[0].from) / (charts[0].to - charts[0].from) * (moving.rows - 1));
  };
  svg.addEventListener("pointerdown", scrub);
  svg.addEventListener("pointermove", scrub);
}
byId("copy").addEventListener("click", async () => {
  const code = byId("command"), button = byId("copy");
  try {
    await navigator.clipboard.writeText(code.textContent);
  } catch {
    getSelection().selectAllChildren(code);
    document.execCommand("copy");
  }
  button.textContent = "Copied";
  setTimeout(() => { button.textContent = "Copy"; }, 1500);
});
for (const table of document.querySelectorAll(".list")) {
  const buttons = [...table.querySelectorAll("button")];
  for (const [n, button] of buttons.entries()) {
    const open = () => show(place.get(Number(button.dataset.case)), true);
    button.closest("tr").addEventListener("click", open);
    button.addEventListener("keydown", (event) => {
      const to = { ArrowDown: n + 1, ArrowUp: n - 1, Home: 0, End: buttons.length - 1 }[event.key];
      if (to === undefined || !buttons[to]) return;
      event.preventDefault();
      buttons[to].focus();
      show(place.get(Number(buttons[to].dataset.case)));
    });
  }
}

/* ---------- the search ---------- */
function search() {
  const { batch, levels } = data.search;
  if (!batch.length) return;
  const bars = [], xRange = [batch[0], batch[batch.length - 1] + data.search.width];
  let most = 1;
  batch.forEach((b, n) => {
    let y = 0;
    for (const { level, cases: counted } of levels) {
      bars.push({ name: `box level${level}`, x0: b, x1: b + data.search.width, y0: y, y1: y + counted[n] });
      y += counted[n];
    }
    most = Math.max(most, y);
  });
  const lines = (key) => levels.map((of) => ({ name: `level${of.level}`, points: of[key].map((y, n) => [batch[n] + data.search.width / 2, y]).filter(([, y]) => y !== null) })).filter(({ points }) => points.length);
  const common = { xRange, xLabel: "batch" };
  plot(byId("chart-share"), { ...common, yRange: [0, most * 1.05], lines: [], bars });
  const scores = lines("score"), coverage = lines("fmc");
  plot(byId("chart-score"), { ...common, yRange: range(scores.flatMap(({ points }) => points.map(([, y]) => y)).concat(scores.length ? [] : [0])), lines: scores });
  plot(byId("chart-fmc"), { ...common, yRange: [0, Math.max(...coverage.flatMap(({ points }) => points.map(([, y]) => y)), 0.001) * 1.1], lines: coverage });
}

if (byId("psi")) {
  byId("psi").addEventListener("input", (event) => setPsi(Number(event.target.value), false));
  byId("psi-all").addEventListener("change", (event) => setPsi(psi, event.target.checked));
}
const worst = document.querySelector(".list button");
const worst2 = cases.index.findIndex((_, i) => cases.level[i] === 2 && failed(i));
if (byId("psi")) setPsi(worst2 < 0 ? (dims.psi[0] + dims.psi[1]) / 2 : cases.psi[worst2], false);
for (const map of maps) map.draw();
search();
if (worst) show(place.get(Number(worst.dataset.case)));
addEventListener("resize", () => at(step));
addEventListener("beforeprint", () => at(step));
