"use strict";
// The motion of a case: the road from above, and charts over time.
// Everything that is drawn comes from the JSON in #data; text is set as text, never as markup.
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const namespace = document.querySelector("svg").namespaceURI;
const DT = data.dt, CRASH = data.crash_m;
const LANE = data.lane; // an acceleration lane: [begin, end], or null
const vehicles = data.vehicles, POV = vehicles.indexOf("pov"), VUT = vehicles.indexOf("vut");
const NAMES = { pov: "POV", vut: "VUT", ahead: "car ahead", behind: "car behind" };
const cases = data.cases;

function draw(parent, tag, attributes = {}, text = null) {
  const node = document.createElementNS(namespace, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text !== null) node.textContent = text;
  parent.append(node);
  return node;
}
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const fixed = (value, digits) => value.toFixed(digits).replace("-", "\u2212");
const signed = (text) => text.replace(/(^|[\s(])-(?=[\d.])/g, "$1\u2212").replace(/m\/s2\b/g, "m/s\u00b2");
// Write numbers of the page as in maps and charts, except in texts of users and in commands.
const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (texts.nextNode()) if (!texts.currentNode.parentElement.closest("script, code, pre, .message, .note, .settings, .untested, h1, option")) texts.currentNode.data = signed(texts.currentNode.data);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const path = (points) => points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(2)} ${y.toFixed(2)}`).join("");

const speedBytes = bytes(data.speeds);
const speeds = new DataView(speedBytes.buffer);
const speedAt = (k) => speeds.getUint16(2 * k, true) * data.speed_unit_mps;

let packed = 0;
const firstRows = (cases.rows ?? []).map((rows) => (packed += rows) - rows); // of each case, in the speeds
function motion(i) {
  // The data has speeds; positions follow by x' = x + v dt, as the vehicles moved.
  const rows = cases.rows[i], first = firstRows[i];
  if (!rows) return null;
  const v = vehicles.map((_, who) => Array.from({ length: rows }, (_, t) => speedAt((first + t) * vehicles.length + who)));
  const x = v.map((speed, who) => {
    const places = [cases.starts[i][who]];
    for (let t = 1; t < rows; t++) places.push(places[t - 1] + speed[t - 1] * DT);
    return places;
  });
  // After this row the follow-up begins.
  const until = Math.round(cases.t_end_s[i] / DT);
  const merge = LANE && cases.end[i] === "MERGED" ? x[VUT][until] : null;
  return { rows, v, x, met: cases.nearest[i], merge, until };
}

/* ---------- plots over time ---------- */
function plot(svg, { xRange, yRange, xLabel, lines, bars = [], bands = [], windows = [], dots = [], flags = [], xTicks = 4, yTicks = true, decimals = null, merged = null }) {
  const [, , w, h] = svg.getAttribute("viewBox").split(" ").map(Number);
  const left = 40, right = w - 12, top = 8, bottom = h - 28;
  const X = (x) => left + (x - xRange[0]) / (xRange[1] - xRange[0] || 1) * (right - left);
  const Y = (y) => bottom - (y - yRange[0]) / (yRange[1] - yRange[0] || 1) * (bottom - top);
  svg.replaceChildren();
  for (const [name, [low, high]] of [...windows.map((ends) => ["window", ends]), ...bands.map((ends) => ["danger", ends])]) {
    const [a, b] = [Y(clamp(high, ...yRange)), Y(clamp(low, ...yRange))];
    draw(svg, "rect", { class: name, x: left, y: a, width: right - left, height: b - a });
  }
  if (merged !== null) draw(svg, "line", { class: "moment", x1: X(merged), x2: X(merged), y1: top, y2: bottom });
  const step = nice((yRange[1] - yRange[0]) / 5);
  for (let y = Math.ceil(yRange[0] / step) * step; yTicks && y <= yRange[1] + 1e-12; y += step) {
    draw(svg, "line", { class: "grid", x1: left, x2: right, y1: Y(y), y2: Y(y) });
    draw(svg, "text", { x: left - 5, y: Y(y) + 4, "text-anchor": "end" }, fixed(Math.abs(y) < step / 1e6 ? 0 : y, decimals ?? digits(step)));
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
  for (const { name, x, y } of dots) draw(svg, "circle", { class: name, cx: X(x), cy: Y(y), r: 4 });
  for (const { name, x, y } of flags) draw(svg, "path", { class: name, d: `M${X(x)} ${Y(y) - 2}l-4.5 -7h9Z` });
  return { X, now: draw(svg, "line", { class: "now", x1: -9, x2: -9, y1: top, y2: bottom }), from: left, to: right, end: xRange[1] };
}
function nice(step) {
  if (!(step > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(step));
  return power * [1, 2, 5, 10].find((f) => f * power >= step);
}
const digits = (step) => Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
function range(values, pad = 0.06) {
  const low = Math.min(...values), high = Math.max(...values), more = pad * (high - low) || 1;
  return [low - more, high + more];
}

/* ---------- road, motion, charts ---------- */
const slider = byId("time"), views = [...document.querySelectorAll(".view svg")].map((svg) => new TopView(svg));
let moving = null, step = 0, final = 0, playing = false, last = 0, charts = [];
// flags: who begins to brake, and when; more: further charts up to a time; earlier: the motion with
// another version, in a view of its own, and behind the other in the charts.
function animate(first, flags, more, earlier = null) {
  const { v, x, met, rows, merge, until } = moving = first;
  const over = (values) => values.map((value, t) => [t * DT, value]);
  const lines = (name) => [[earlier, " earlier"], [first, ""]].flatMap(([motion, which]) => (motion === null ? [] : vehicles.map((car, who) => ({ name: car + which, points: over(motion[name][who]) }))));
  const all = (name) => [...first[name], ...(earlier?.[name] ?? [])].flat();
  const others = vehicles.map((_, who) => who).filter((who) => who !== VUT);
  const gapOf = (motion) => motion.x.map((places) => places.map((place, t) => place - motion.x[VUT][t]));
  const gap = gapOf(first), before = earlier && gapOf(earlier);
  const inView = range([...gap[met], ...(before?.[earlier.met] ?? []), -12, 12]); // of the car that the VUT meets
  const gaps = (values, which) => others.map((who) => ({ name: (others.length > 1 ? vehicles[who] : "gap") + which, points: over(values[who]).filter(([, y]) => y >= inView[0] && y <= inView[1]) }));
  final = Math.max(rows, earlier?.rows ?? 0) - 1;
  const end = final * DT, common = { xRange: [0, end], xLabel: "time, s", merged: until < final ? until * DT : null };
  charts = [
    plot(byId("chart-speed"), { ...common, yRange: range(all("v"), 0.14), lines: lines("v"), flags: flags.map(([who, t]) => ({ name: vehicles[who], x: t, y: v[who][Math.round(t / DT)] })) }),
    plot(byId("chart-position"), { ...common, yRange: range(all("x")), lines: lines("x"), windows: LANE ? [LANE] : [], dots: merge === null ? [] : [{ name: "merged", x: until * DT, y: merge }] }),
    plot(byId("chart-gap"), {
      ...common, yRange: inView, bands: [[-CRASH, CRASH]],
      lines: [...(before ? gaps(before, " earlier") : []), ...gaps(gap, "")],
    }),
    ...more(end),
  ];
  slider.max = final;
  const motions = earlier === null ? [first] : [earlier, first];
  views.forEach((view, n) => motions[n] && view.show(motions[n]));
}
const extent = (values) => [Math.min(...values), Math.max(...values)];
function pose(path, along) { // front bumper at a lane coordinate of a path
  let k = path.findIndex(([at], i) => i > 0 && along < at);
  if (k < 0) k = path.length - 1;
  // Where a lane begins its point stands twice, and some lanes are as short as a point.
  while (k > 1 && path[k][0] === path[k - 1][0]) k--;
  const [[s0, x0, y0], [s1, x1, y1]] = [path[k - 1], path[k]], share = (along - s0) / (s1 - s0 || 1);
  return { x: x0 + share * (x1 - x0), y: y0 + share * (y1 - y0), angle: Math.atan2(y0 - y1, x1 - x0) * 180 / Math.PI };
}
function TopView(svg) {
  const cars = {}, lengthOf = (who) => data.lengths_m[who === "vut" ? 1 : 0];
  let layer; // the cars, the last one on top
  this.show = (motion) => {
    this.moving = motion;
    svg.replaceChildren();
    // A lane is 3.2 m wide: the free space between two lanes is the line between them.
    for (const lane of [data.main, data.ramp]) draw(svg, "path", { class: "lane", d: path(lane.map(([, x, y]) => [x, -y])), "stroke-width": 3.05 });
    LANE ? drawLane() : draw(svg, "line", { class: "merge", x1: 0, x2: 0, y1: -2.6, y2: 2.6, "stroke-width": 0.25 });
    layer = draw(svg, "g");
    const outlines = draw(svg, "g"); // above all bodies, so that a car below another one is seen
    for (const who of vehicles) {
      const group = draw(layer, "g");
      const length = lengthOf(who), side = { y: -data.width_m / 2, height: data.width_m };
      const body = { x: -length, width: length, rx: 0.4, ...side };
      draw(group, "rect", { class: `car ${who}`, ...body });
      const outline = draw(outlines, "rect", { class: `outline ${who}`, ...body });
      const brake = draw(group, "rect", { class: "brake", x: -length, width: 0.5, ...side });
      cars[who] = { group, outline, brake, label: draw(svg, "text", { "text-anchor": "middle" }) };
    }
  };
  const across = (name, from, to, x) => { // a line over the road between two paths, at a lane coordinate
    const a = pose(from, x), b = pose(to, x), length = Math.hypot(b.x - a.x, b.y - a.y) || 1, u = 2.4 * (b.x - a.x) / length, v = 2.4 * (b.y - a.y) / length;
    draw(svg, "line", { class: name, x1: a.x - u, y1: -(a.y - v), x2: b.x + u, y2: -(b.y + v), "stroke-width": 0.25 });
  };
  const drawLane = () => { // the acceleration lane, and where the VUT left it
    const begin = LANE[0] + 0.01, end = LANE[1] - 0.01; // its ends are also points of other lanes
    const inside = data.ramp.filter(([at]) => at > begin && at < end).map(([at]) => at);
    const points = [begin, ...inside, end].map((at) => pose(data.ramp, at));
    draw(svg, "path", { class: "window", d: path(points.map(({ x, y }) => [x, -y])), "stroke-width": 3.05 });
    if (this.moving.merge !== null) across("merge", data.main, data.ramp, Math.min(this.moving.merge, end));
  };
  this.at = (time) => {
    const { rows, x: xs, v: vs, merge, until } = this.moving, t = Math.min(time, rows - 1), k = Math.min(Math.floor(t), Math.max(rows - 2, 0)), next = Math.min(k + 1, rows - 1);
    const mix = (values) => values[k] + (t - k) * (values[next] - values[k]); // between two rows
    const merged = merge !== null && t >= until;
    const places = xs.map((x, who) => {
      const along = mix(x), lane = who === VUT && !merged ? data.ramp : data.main;
      const front = pose(lane, along), rear = pose(lane, along - lengthOf(vehicles[who]));
      // Both bumpers are on the lane, as where overlaps are measured.
      return { ...front, along, angle: Math.atan2(rear.y - front.y, front.x - rear.x) * 180 / Math.PI };
    });
    // The one behind lies on top: so both front bumpers are seen where two cars overlap.
    const order = vehicles.map((_, who) => who).sort((a, b) => places[b].along - places[a].along);
    const groups = order.map((who) => cars[vehicles[who]].group);
    if (groups.some((group, k) => group !== layer.children[k])) layer.replaceChildren(...groups);
    const apart = Math.min(...places.flatMap((a, who) => places.slice(who + 1).map((b) => Math.hypot(a.x - b.x, a.y - b.y))));
    const vutAbove = places[VUT].y > places[POV].y;
    // The view follows all cars, never closer than 60 m.
    const [low, high] = extent(places.map(({ x }) => x)), [bottom, top] = extent(places.map(({ y }) => y));
    const ratio = svg.clientHeight / (svg.clientWidth || 1) || 0.25, middle = (low + high) / 2, centre = (bottom + top) / 2;
    const width = Math.max(high - low + 50, (1.7 * (top - bottom) + 15) / ratio, 60), height = width * ratio;
    const size = Math.max(1, Math.min(width / 90, height / 22.5)); // labels fit
    const larger = clamp(apart / 10, 1, Math.min(size, 2.2)); // seen from afar, and to scale where two are near
    // Letters are 11 to 15 pixels high.
    const pixel = width / (svg.clientWidth || 400), letters = clamp(2.6 * size, 11 * pixel, 15 * pixel), aside = 0.5 * width - 3.6 * letters;
    svg.setAttribute("viewBox", `${middle - width / 2} ${-centre - height / 2} ${width} ${height}`);
    for (const [who, name] of vehicles.entries()) {
      const { x, y, angle } = places[who], v = vs[who], a = (v[next] - v[k]) / DT;
      const { group, outline, brake, label } = cars[name];
      for (const part of [group, outline]) part.setAttribute("transform", `translate(${x} ${-y}) rotate(${angle}) scale(${larger})`);
      brake.setAttribute("visibility", a < -0.2 ? "visible" : "hidden");
      const up = (who === VUT) === vutAbove, named = who === VUT || who === POV;
      label.setAttribute("x", clamp(x + 3.6 * letters, middle - aside, middle + aside)); // ahead of the front bumper: the ramp is behind it
      const below = -y + (up ? -3.8 * Math.min(size, 2) - letters : 2.8 * Math.min(size, 2) + letters);
      label.setAttribute("y", clamp(below, letters - centre - height / 2, height / 2 - centre - 0.4 * letters));
      label.style.fontSize = `${letters}px`;
      label.textContent = named ? `${NAMES[name]} ${fixed(mix(v), 1)} m/s` : name;
      // The POV's own label has the room where two would lie on each other.
      label.setAttribute("visibility", named || Math.abs(x - places[POV].x) > 0.14 * width ? "visible" : "hidden");
    }
  };
}
function at(t) {
  if (!moving) return;
  step = clamp(t, 0, final);
  for (const view of views) if (view.moving) view.at(step);
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
  if (step >= final) at(0);
  last = performance.now();
  requestAnimationFrame(frame);
}
function frame(now) {
  if (!playing) return;
  at(step + (now - last) / 1000 / DT * Number(byId("rate").value));
  last = now;
  step >= final ? play(false) : requestAnimationFrame(frame);
}
slider.addEventListener("input", () => { play(false); at(Number(slider.value)); });
byId("play").addEventListener("click", () => play(!playing));
slider.addEventListener("keydown", (event) => {
  if (event.key === " ") { event.preventDefault(); play(!playing); }
});
for (const id of ["chart-speed", "chart-position", "chart-gap"]) {
  const svg = byId(id);
  const scrub = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    play(false);
    at((point.x - charts[0].from) / (charts[0].to - charts[0].from) * charts[0].end / DT);
  };
  svg.addEventListener("pointerdown", scrub);
  svg.addEventListener("pointermove", scrub);
}
addEventListener("resize", () => at(step));
addEventListener("beforeprint", () => at(step));
