// The report around its player (player.js): maps, the view of a case, and the table of all cases.
const coordinates = data.coordinates; // of all levels; the last ones belong to some levels only
const place = new Map(cases.index.map((index, i) => [index, i]));

/* ---------- cases ---------- */
const failed = (i) => cases.failed[i];
const undecided = (i) => cases.undecided[i]; // it fails, and has too few runs to tell
let matching = null; // the cases that match the filters; null without a filter
const wanted = (i) => matching === null || matching.has(i);
function avoidedBy(i, who) { // a driver, "pov" or "none"
  const known = failed(i) ? cases.avoidance[i] : null;
  if (known === null) return false;
  const by = known.avoided_by;
  return who === "pov" ? known.pov_careful : who === "none" ? by.length === 0 : by.includes(who);
}
const tested = (i) => failed(i) || cases.end[i] === "MERGED";
const severity = (i) => cases.severity[i];
function drawMark(parent, i, x, y, faint) { // shape and colour by severity; failures are large
  const found = severity(i), large = failed(i);
  const look = { class: `mark ${found ?? (large ? "unclassed" : "error")}${large ? " fail" : ""}${faint}`, "data-case": cases.index[i] };
  const r = large ? 5 : 3.4;
  if (found === "contact" || found === "conflict" || (found === null && large)) return draw(parent, "path", { ...look, d: `M${x} ${y - r}l${r} ${r}l${-r} ${r}l${-r} ${-r}Z` });
  if (found === null) return draw(parent, "rect", { ...look, x: x - 3, y: y - 3, width: 6, height: 6 });
  return draw(parent, "circle", { ...look, cx: x, cy: y, r: large ? 4.2 : found === "safe" ? 2.4 : 3.2 });
}
function runsOf(i) { // of a case that ran more than once
  const runs = cases.runs?.[i] ?? null;
  return runs && { ...runs, number: runs.each.length, failed: runs.each.filter(([, fails]) => fails).length };
}
function drawShare(parent, i, x, y, faint) { // an arc from the top, clockwise: the share of its runs that fail
  const runs = runsOf(i), share = runs && 100 * runs.failed / runs.number;
  if (!share || share === 100) return;
  draw(parent, "circle", { class: `of-runs${faint}`, cx: x, cy: y, r: 8, pathLength: 100, "stroke-dasharray": `${share} ${100 - share}`, transform: `rotate(-90 ${x} ${y})` });
}
function runsInWords(i) {
  const runs = runsOf(i), percent = (share) => fixed(100 * share, 0);
  if (!runs) return cases.runs && tested(i) ? "This case ran once." : "";
  const each = runs.each.map(([index, fails]) => `${index} ${fails ? "fails" : "passes"}`).join(", ");
  return `Fails in ${runs.failed} of ${runs.number} runs (95 % interval ${percent(runs.low)} to ${percent(runs.high)} %): ${each}. Run ${cases.index[i]} decides the result and is shown.`;
}
const rank = (i) => (severity(i) === null ? data.severities.length : data.severities.indexOf(severity(i))); // the most severe lie on top
const valueText = (c, value) => `${fixed(value, c.digits)} ${c.unit}`;

function title(i) {
  const place = coordinates.filter((c) => cases[c.field][i] !== null).map((c) => `${c.name} ${valueText(c, cases[c.field][i])}`.replaceAll(" ", "\u00a0"));
  return `POV level ${data.level_names[cases.level[i]]}, ${place.join(", ")}`;
}
function words(i) {
  const { [i]: result } = cases.result;
  return signed([`${result[0].toUpperCase()}${result.slice(1)}.`, runsInWords(i)].filter(Boolean).join(" "));
}

/* ---------- grids: the surrogate's failure probability ---------- */
function slice(grid, at) { // `at` a share of the third coordinate; null for all of it at once
  if (!grid.values) grid.values = bytes(grid.data);
  const { nx, ny, np, values } = grid, size = nx * ny;
  if (np === 1) return values;
  const out = new Float32Array(size);
  if (at === null) { // the highest of all
    for (let k = 0; k < np; k++) for (let n = 0; n < size; n++) out[n] = Math.max(out[n], values[k * size + n]);
    return out;
  }
  const place = clamp(at, 0, 1) * (np - 1), low = Math.min(Math.floor(place), np - 2), share = place - low;
  for (let n = 0; n < size; n++) out[n] = (1 - share) * values[low * size + n] + share * values[(low + 1) * size + n];
  return out;
}
function shade(svg, values, nx, ny, box, clip) {
  const canvas = document.createElement("canvas");
  canvas.width = nx; canvas.height = ny;
  const context = canvas.getContext("2d"), image = context.createImageData(nx, ny);
  for (let j = 0; j < ny; j++) for (let i = 0; i < nx; i++) {
    const at = 4 * ((ny - 1 - j) * nx + i);
    image.data.set([213, 94, 0, Math.round(0.55 * values[j * nx + i])], at);
  }
  context.putImageData(image, 0, 0);
  const [x, y, w, h] = box, dx = w / (nx - 1), dy = h / (ny - 1);
  draw(svg, "image", { href: canvas.toDataURL(), x: x - dx / 2, y: y - dy / 2, width: w + dx, height: h + dy, preserveAspectRatio: "none", "clip-path": `url(#${clip})` });
}

/* ---------- maps ---------- */
const BOX = [48, 6, 346, 184]; // x, y, width, height of the plot in a map
const unit = (c, value) => (value - c.low) / (c.high - c.low);
let chosen = -1;
const maps = [...document.querySelectorAll(".map")].map((figure) => new FailureMap(figure));

function FailureMap(figure) {
  const svg = figure.querySelector(":scope > svg"), level = Number(figure.dataset.level), of = data.maps[level];
  const [left, top, width, height] = BOX;
  const X = (u) => left + u * width, Y = (v) => top + (1 - v) * height; // of shares of the pool
  const own = cases.index.map((_, i) => i).filter((i) => cases.level[i] === level);
  const third = of.dims === 3 ? coordinates[2] : null; // the reader moves through it
  const slider = figure.querySelector("input[type=range]"), check = figure.querySelector("input[type=checkbox]");
  const pairs = figure.querySelector("select");
  for (const pair of of.pairs) pairs?.add(new Option(pair.map((k) => coordinates[k].name).join(" × ")));
  let pair = 0, at = 0, all = true, axes = [], marks = [];
  const apart = (i) => (all ? 0 : Math.abs(cases[third.field][i] - at));
  const near = (i) => all || apart(i) <= (third.high - third.low) / 16;

  const ball = (parent, { i, x, y }, radius) => { // the slice of a ball around a case
    const off = all ? 0 : apart(i) / (third.high - third.low);
    if (off >= radius) return;
    const r = Math.sqrt(radius ** 2 - off ** 2);
    draw(parent, "ellipse", { cx: x, cy: y, rx: r * width, ry: r * height });
  };
  const place = () => {
    axes = of.pairs[pair].map((k) => coordinates[k]);
    const [across, up] = axes;
    marks = own.map((i) => ({ i, x: X(unit(across, cases[across.field][i])), y: Y(unit(up, cases[up.field][i])) }))
      .sort((a, b) => failed(a.i) - failed(b.i) || rank(b.i) - rank(a.i));
  };
  this.level = level;
  this.draw = () => {
    const { probability } = of, share = all ? null : unit(third, at);
    svg.replaceChildren();
    const clip = draw(draw(svg, "defs"), "clipPath", { id: "clip" });
    draw(clip, "rect", { x: left, y: top, width, height });
    if (probability && data.varies) { // further from cases that ran more than once the surrogate says too much
      const known = draw(clip.parentNode, "clipPath", { id: `known${level}`, "clip-path": "url(#clip)" });
      for (const mark of marks) if (runsOf(mark.i)) ball(known, mark, of.radius / 2);
    }
    if (probability) shade(svg, slice(probability, share), probability.nx, probability.ny, BOX, data.varies ? `known${level}` : "clip");
    for (const [n, c] of axes.entries()) {
      const vertical = n === 0, span = c.high - c.low;
      const step = ticks(span / (vertical ? 4 : 5));
      for (let value = Math.ceil(c.low / step - 1e-9) * step; value <= c.high + 1e-9; value += step) {
        const u = unit(c, value);
        draw(svg, "line", vertical ? { class: "grid", x1: X(u), x2: X(u), y1: top, y2: top + height } : { class: "grid", x1: left, x2: left + width, y1: Y(u), y2: Y(u) });
        draw(svg, "text", vertical ? { x: X(u), y: top + height + 15, "text-anchor": "middle" } : { x: left - 6, y: Y(u) + 4, "text-anchor": "end" }, fixed(value, digits(step)));
      }
    }
    const [across, up] = axes.map((c) => `${c.name}, ${c.unit}`);
    draw(svg, "text", { x: left + width / 2, y: top + height + 32, "text-anchor": "middle" }, across);
    draw(svg, "text", { transform: `translate(12 ${top + height / 2}) rotate(-90)`, "text-anchor": "middle" }, up);
    counts();
    const balls = draw(svg, "g", { class: "balls", "clip-path": "url(#clip)" });
    for (const mark of marks) if (failed(mark.i)) ball(balls, mark, of.dims <= 3 ? of.radius : 0); // in more coordinates it is as wide as the map
    draw(svg, "rect", { class: "frame", x: left, y: top, width, height });
    for (const { i, x, y } of marks) {
      const faint = near(i) && wanted(i) ? "" : " faint";
      drawMark(svg, i, x, y, faint);
      drawShare(svg, i, x, y, faint);
    }
    numbers();
    this.choose();
  };
  this.move = (value, everything) => {
    at = value; all = everything;
    slider.value = value;
    check.checked = slider.disabled = all;
    const degrees = third.unit === "rad" ? ` (${Math.round(value * 180 / Math.PI)}°)` : "";
    figure.querySelector("output").textContent = all ? "" : valueText(third, value) + degrees;
    this.draw();
  };
  this.showAll = () => (third ? this.move(at, true) : this.draw());
  this.lookAt = (i) => { if (cases.level[i] === level && !near(i)) this.move(cases[third.field][i], false); };
  const numbers = () => { // of the regions that the list describes, each at its case next to their middle
    const taken = [];
    for (const region of data.regions) {
      const inside = region.level === level ? marks.filter(({ i }) => cases.region[i] === region.number && near(i) && wanted(i)) : [];
      if (!inside.length) continue;
      const middle = (key) => inside.reduce((sum, mark) => sum + mark[key], 0) / inside.length, [x, y] = [middle("x"), middle("y")];
      const off = (mark) => Math.hypot(mark.x - x, mark.y - y);
      const at = inside.reduce((best, mark) => (off(mark) < off(best) ? mark : best));
      const side = at.x > left + width - 24 ? -1 : 1, spot = { x: at.x + side * 10, y: clamp(at.y + 4, top + 11, top + height - 3) };
      const other = taken.find(({ x, y }) => Math.abs(x - spot.x) < 14 && Math.abs(y - spot.y) < 11);
      if (other) { other.text.textContent += `, ${region.number + 1}`; continue; }
      const text = draw(svg, "text", { class: "named number", ...spot, "text-anchor": side < 0 ? "end" : "start" }, String(region.number + 1));
      taken.push({ ...spot, text });
    }
  };
  const counts = () => { // of a long campaign: the cases that are not listed one by one
    if (!of.counts.length) return;
    const [safe, failing] = of.counts[pair], [nx, ny] = data.count_grid;
    const most = Math.max(...safe, ...failing, 1);
    for (let n = 0; n < nx * ny; n++) {
      const x = X((n % nx) / nx), y = Y((Math.floor(n / nx) + 1) / ny);
      for (const [name, count] of [["count", safe[n]], ["count failing", failing[n]]]) if (count) {
        draw(svg, "rect", { class: name, x, y, width: width / nx, height: height / ny, "clip-path": "url(#clip)", "fill-opacity": (0.08 + 0.5 * count / most).toFixed(3) });
      }
    }
  };
  this.choose = () => {
    svg.querySelector(".chosen")?.remove();
    const mark = marks.find((m) => m.i === chosen);
    if (mark) draw(svg, "circle", { class: "chosen", cx: mark.x, cy: mark.y, r: 8 });
  };
  const visible = () => marks.filter((m) => near(m.i) && wanted(m.i));
  const pointOf = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  const under = (event) => {
    const point = pointOf(event);
    let best = null, least = 14;
    for (const mark of visible()) {
      const distance = Math.hypot(mark.x - point.x, mark.y - point.y) - (failed(mark.i) ? 3 : 0);
      if (distance < least) [best, least] = [mark, distance];
    }
    return best;
  };
  const drawn = (i) => svg.querySelector(`[data-case="${cases.index[i]}"]`);
  svg.addEventListener("click", (event) => { const mark = under(event); if (mark) openCase(mark.i, drawn(mark.i)); });
  svg.addEventListener("pointermove", (event) => {
    const mark = event.pointerType === "touch" ? null : under(event);
    mark ? tip(event, `Case ${cases.index[mark.i]} · ${title(mark.i)}`) : tip(null);
  });
  svg.addEventListener("pointerleave", () => tip(null));
  svg.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!way) return;
    event.preventDefault();
    const here = marks.find((m) => m.i === chosen);
    const seen = visible();
    if (!here) { if (seen.length) openCase(seen[seen.length - 1].i, svg); return; }
    let best = null, least = Infinity;
    for (const mark of seen) {
      const dx = mark.x - here.x, dy = mark.y - here.y;
      const along = dx * way[0] + dy * way[1], aside = Math.abs(dx * way[1]) + Math.abs(dy * way[0]);
      if (along > 0.01 && along + 3 * aside < least) [best, least] = [mark, along + 3 * aside];
    }
    if (best) openCase(best.i, drawn(best.i));
  });
  slider?.addEventListener("input", () => this.move(Number(slider.value), false));
  check?.addEventListener("change", () => this.move(at, check.checked));
  pairs?.addEventListener("change", () => { pair = pairs.selectedIndex; place(); this.draw(); });
  place();
  const worst = own.find(failed);
  if (third) at = worst === undefined ? (third.low + third.high) / 2 : cases[third.field][worst];
}
const tipBox = document.createElement("div");
tipBox.className = "tip"; tipBox.hidden = true;
document.body.append(tipBox);
function tip(event, text) {
  tipBox.hidden = event === null;
  if (!event) return;
  tipBox.textContent = text;
  const { clientWidth, clientHeight } = document.documentElement;
  const below = event.clientY + 14 + tipBox.offsetHeight < clientHeight;
  tipBox.style.left = `${Math.max(4, Math.min(event.clientX + 12, clientWidth - tipBox.offsetWidth - 8))}px`;
  tipBox.style.top = `${below ? event.clientY + 14 : event.clientY - 10 - tipBox.offsetHeight}px`;
}
function ticks(step) {
  const power = 10 ** Math.floor(Math.log10(step));
  return power * [1, 2, 4, 5, 10].find((f) => f * power >= step - 1e-9);
}

/* ---------- a case: road, motion, charts ---------- */
const panel = byId("case");
function dock(on) { // at the bottom of the window, or in its place next to the maps
  panel.classList.toggle("docked", on);
  byId("close").hidden = !on;
  if (moving) at(step);
}
function openCase(i, element = null) { // the reader opens a case: keep the case and the clicked element in sight
  tip(null);
  const before = element?.getBoundingClientRect().top;
  show(i);
  opened = i;
  history.replaceState(null, "", address());
  const { top, height } = panel.getBoundingClientRect();
  if (top < 0 || top + Math.min(height, 380) > innerHeight) dock(true);
  if (!element) return;
  // The clicked element keeps its place, or moves up as far as the case would hide it.
  const at = element.getBoundingClientRect(), room = panel.classList.contains("docked") ? panel.getBoundingClientRect().top - 12 - at.height : Infinity;
  scrollBy({ top: at.top - Math.min(before, room), behavior: "instant" });
}

/* ---------- the address: #case-111&verdict=failure ---------- */
const form = byId("filters"), FILTERS = ["level", "verdict", "severity", "region", "kind", "avoided", "measure", "from", "to"];
let opened = -1; // the case that the reader asked for
function filtersSet() { // [name, value] of each filter that is set
  const bounded = form.elements.from.value !== "" || form.elements.to.value !== "";
  return FILTERS.map((name) => [name, form.elements[name]?.value ?? ""]).filter(([name, value]) => value !== "" && (name !== "measure" || bounded));
}
function address(i = opened) {
  const linked = i < 0 ? [] : [`case-${cases.index[i]}`];
  return `#${[...linked, new URLSearchParams(filtersSet()).toString()].filter(Boolean).join("&")}`;
}
function openLinked() {
  const index = Number(/^#case-(\d+)(&|$)/.exec(location.hash)?.[1] ?? NaN);
  if (!place.has(index)) return false;
  if (place.get(index) !== opened) openCase(place.get(index));
  return true;
}
function restore() { // an address is data: skip unknown names and values
  const query = new URLSearchParams(location.hash.slice(1));
  form.reset();
  for (const name of FILTERS) {
    const control = form.elements[name], value = query.get(name);
    if (!control || value === null || (control.type === "number" && !/^-?\d{1,15}(\.\d{1,15})?$/.test(value))) continue;
    control.value = value;
    if (control.selectedIndex < 0) control.selectedIndex = 0;
  }
}
addEventListener("hashchange", () => { restore(); filter(); openLinked(); });
addEventListener("keydown", (event) => { if (event.key === "Escape") dock(false); });
addEventListener("beforeprint", () => { byId("facts").closest("details").open = true; });
addEventListener("scroll", () => { // undock the case when its place is in sight
  const { top } = byId("case-place").getBoundingClientRect();
  if (panel.classList.contains("docked") && top >= 0 && top + 380 <= innerHeight) dock(false);
}, { passive: true });
byId("close").addEventListener("click", () => dock(false));

function show(i) {
  chosen = i;
  for (const map of maps) map.lookAt(i);
  byId("case-start").textContent = ` · ${title(i)}`;
  byId("case-words").textContent = words(i);
  const link = byId("case-link");
  link.href = address(i);
  link.textContent = `Case ${cases.index[i]}`;
  for (const place of document.querySelectorAll("code .index")) place.textContent = cases.index[i];
  for (const map of maps) map.choose();
  for (const button of document.querySelectorAll("[data-case]")) {
    button.closest("tr")?.classList.toggle("on", Number(button.dataset.case) === cases.index[i]);
  }
  byId("case-role").textContent = cases.index[i] !== Number(panel.dataset.first) ? verdict(i) : failed(i) ? `worst case${undecided(i) ? ", undecided" : ""}` : tested(i) ? "no failure; the case nearest to one" : verdict(i);
  byId("case-role").title = cases.margin[i] === null || !tested(i) ? "" : `margin ${fixed(cases.margin[i], 3)}${failed(i) && cases.index[i] === Number(panel.dataset.first) ? ": the lowest of all cases" : ""}`;
  moving = motion(i);
  byId("case-motion").hidden = moving === null;
  byId("why").hidden = !failed(i) || moving === null;
  play(false);
  timeline(i);
  if (moving) showMotion(i);
}
function showMotion(i) {
  const flags = cases.events[i].filter(([, text]) => text.includes(" brakes: ")).map(([t, , car]) => [vehicles.indexOf(car), t]);
  animate(moving, flags, (end) => signalCharts(i, end));
  whyCharts(i);
  at(failed(i) ? moving.until : 0);
  const [row, what] = cases.conflict[i];
  const short = what.endsWith("collision") ? "lowest TTC" : what.split(" ")[1]; // such as: the contact, the end of the episode
  Object.assign(byId("before"), { textContent: `3 s before ${short}`, title: `Plays from 3 s before ${what} at ${fixed(row * DT, 1)} s`, onclick: () => { at(row - 3 / DT); if (!playing) play(true); } });
}
function timeline(i) { // the events of a case as a list, and as marks on the time axis of the player
  const marks = [], lines = [], end = moving && (moving.rows - 1) * DT;
  for (const [n, [t, words, actor]] of cases.events[i].entries()) {
    const text = signed(words), car = (failed(i) && n + 1 === cases.events[i].length) || /^the VUT (reaches|merges) /.test(text) ? null : actor; // the outcome is of no car
    const line = document.createElement("li"), button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: `${fixed(t, 1)} s`, disabled: !moving });
    button.addEventListener("click", () => { play(false); at(t / DT); });
    line.append(button, ` ${text}`);
    lines.push(line);
    if (!moving) continue;
    const mark = document.createElement("button");
    Object.assign(mark, { type: "button", className: car ?? "", title: `${fixed(t, 1)} s: ${text}` });
    mark.setAttribute("aria-label", mark.title);
    mark.style.setProperty("--at", t / (end || 1));
    mark.addEventListener("click", () => { play(false); at(t / DT); });
    marks.push(mark);
  }
  byId("case-timeline").replaceChildren(...lines);
  byId("marks").replaceChildren(...marks);
}
function whyCharts(i) { // changes that make a failure pass
  const found = data.why[cases.index[i]];
  byId("why-known").hidden = !found;
  byId("why-ask").hidden = Boolean(found);
  if (!found) return;
  byId("why-words").replaceChildren(...found.words.map((text) => Object.assign(document.createElement("li"), { textContent: signed(text) })));
  drawAxes(byId("why-changes"), found.axes);
}
function drawAxes(svg, axes) { // a bar for each quantity: failing values around the case, and the nearest passing values
  const height = 56, [left, right] = [62, 298];
  svg.setAttribute("viewBox", `0 0 360 ${axes.length * height}`);
  svg.replaceChildren();
  for (const [row, { name, unit, value, digits, low, below, above, high }] of axes.entries()) {
    const y = row * height, reach = 1.5 * Math.max(value - (below ?? low), (above ?? high) - value) || 1; // as far as needed
    const from = Math.max(low, value - reach), to = Math.max(Math.min(high, value + reach), from + 1e-9);
    const X = (at) => left + (at - from) / (to - from) * (right - left);
    draw(svg, "text", { x: left, y: y + 13 }, `${name} ${fixed(value, digits)} ${unit}`.trim());
    draw(svg, "rect", { class: "track", x: left, y: y + 20, width: right - left, height: 12 });
    draw(svg, "rect", { class: "stuck", x: X(below ?? from), y: y + 20, width: X(above ?? to) - X(below ?? from), height: 12 });
    draw(svg, "line", { class: "now", x1: X(value), x2: X(value), y1: y + 17, y2: y + 35 });
    for (const [at, anchor, aside] of [[below, "end", -8], [above, "start", 8]]) {
      if (at === null) continue;
      draw(svg, "circle", { class: "passes", cx: X(at), cy: y + 26, r: 4 });
      draw(svg, "text", { x: X(at) + aside, y: y + 30, "text-anchor": anchor }, fixed(at, digits));
    }
    for (const end of [from, to]) draw(svg, "text", { class: "edge", x: X(end), y: y + 45, "text-anchor": "middle" }, fixed(end, digits));
  }
}
function signalCharts(i, end) { // signals of the VUT at each step: numbers as a line, words as bars
  const box = byId("signals"), left = Object.entries(data.signals[cases.index[i]] ?? {});
  box.replaceChildren();
  box.hidden = left.length === 0;
  return left.map(([name, runs]) => {
    const figure = box.appendChild(document.createElement("figure"));
    figure.appendChild(document.createElement("figcaption")).textContent = `signal ${name}`;
    const spans = []; // [from, to, value], in seconds
    let row = 0;
    for (const [count, value] of runs) {
      if (value !== null) spans.push([row * DT, (row + count) * DT, value]);
      row += count;
    }
    const svg = draw(figure, "svg", { viewBox: "0 0 240 150", role: "img", "aria-label": `Signal ${name} over time` });
    const values = [...new Set(spans.map(([, , value]) => value))], words = values.some((value) => typeof value === "string");
    const common = { xRange: [0, end], xLabel: "time, s" };
    if (!words) {
      const points = spans.map(([from, to, y]) => [[from, y], [to, y]]);
      return plot(svg, { ...common, yRange: range(values), lines: points.map((part, n) => ({ name: "vut", points: n && spans[n - 1][1] === spans[n][0] ? [points[n - 1][1], ...part] : part })) });
    }
    const shown = values.slice(0, 8).map(String), place = (value) => shown.length - 1 - shown.indexOf(String(value));
    const bars = spans.filter(([, , value]) => shown.includes(String(value))).map(([x0, x1, value]) => ({ name: "vut word", x0, x1, y0: place(value) + 0.1, y1: place(value) + 0.45 }));
    const chart = plot(svg, { ...common, yRange: [0, shown.length], lines: [], bars, yTicks: false });
    for (const [n, word] of shown.entries()) draw(svg, "text", { x: 44, y: 8 + (n + 0.45) * 114 / shown.length }, word);
    return chart;
  });
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
    const row = button.closest("tr");
    row.addEventListener("click", () => openCase(place.get(Number(button.dataset.case)), row));
    button.addEventListener("keydown", (event) => {
      const to = { ArrowDown: n + 1, ArrowUp: n - 1, Home: 0, End: buttons.length - 1 }[event.key];
      if (to === undefined || !buttons[to]) return;
      event.preventDefault();
      buttons[to].focus();
      openCase(place.get(Number(buttons[to].dataset.case)), buttons[to]);
    });
  }
}

/* ---------- all cases ---------- */
const verdict = (i) => (undecided(i) ? "undecided" : failed(i) ? "failure" : tested(i) ? "no failure" : cases.end[i]);
function allCases() { // returns a function that shows the cases that match the filters
  const head = byId("table").tHead.rows[0], body = byId("table").tBodies[0], more = byId("more");
  const { level, severity: severe, verdict: ended, region, kind, measure, from, to } = form.elements, avoided = form.elements.avoided; // null where that is not known
  const number = (key, name, digits) => ({ name, exact: true, value: (i) => cases[key][i], text: (value) => fixed(value, digits) });
  const kindOf = (i) => cases.kind[i];
  const columns = [
    { name: "case", exact: true, value: (i) => cases.index[i] },
    { name: "level", value: (i) => cases.level[i], text: (value) => data.level_names[value] },
    { name: "verdict", words: true, value: verdict, text: (value, i) => (tested(i) || !cases.error[i] ? value : `${value}: ${cases.error[i]}`) },
    { name: "severity", words: true, value: severity, order: rank },
    { name: "kind", words: true, value: kindOf },
    { name: "region", value: (i) => cases.region[i], text: (value) => String(value + 1) },
    ...coordinates.map((c) => number(c.field, `${c.name}${c.unit === "rad" ? "" : ` ${c.unit}`}`, c.digits)),
    ...(cases.runs ? [
      { name: "runs", exact: true, value: (i) => runsOf(i)?.number ?? 1, text: String },
      { name: "share of runs that fail", exact: true, value: (i) => { const runs = runsOf(i); return runs ? runs.failed / runs.number : tested(i) ? Number(failed(i)) : null; }, text: (value) => fixed(value, 2) },
    ] : []),
    number("margin", "margin", 2),
    ...data.measures.filter(({ name }) => cases[name]?.some((value) => value !== null)).map(({ name, title, unit, digits }) => number(name, `${title} ${unit.replace("s2", "s²")}`.trim(), digits)),
  ];
  const all = cases.index.map((_, i) => i), PART = 100;
  let by = columns.find(({ name }) => name === "margin"), way = 1, found = all, rows = 0;

  const option = (select, value, text = value) => select.add(new Option(text, value));
  const count = (value) => {
    const counts = new Map();
    for (const i of all) if (value(i) !== null) counts.set(value(i), (counts.get(value(i)) ?? 0) + 1);
    return counts;
  };
  const message = (i) => (tested(i) ? null : cases.error[i]);
  const where = (i) => (cases.region[i] === null ? null : `${cases.level[i]}:${cases.region[i]}`);
  for (const [value] of count((i) => cases.level[i])) option(level, value, data.level_names[value]);
  for (const [value, n] of count(verdict)) option(ended, value, `${value} (${n})`);
  for (const [value, n] of count(message)) option(ended, `: ${value}`, `${value.slice(0, 60)} (${n})`);
  const ordered = [...count(where)].map(([value, n]) => [value.split(":").map(Number), value, n]);
  ordered.sort(([a], [b]) => a[0] - b[0] || a[1] - b[1]);
  for (const [[l, r], value, n] of ordered) option(region, value, `level ${data.level_names[l]}, region ${r + 1} (${n})`);
  for (const [value, n] of count(kindOf)) option(kind, value, `${value} (${n})`);
  const severities = count(severity);
  for (const value of data.severities) if (severities.has(value)) option(severe, value, `${value} (${severities.get(value)})`);
  for (const c of columns) if (c.exact && c.name !== "case") option(measure, c.name);

  for (const c of columns) {
    const cell = head.appendChild(document.createElement("th")), button = cell.appendChild(document.createElement("button"));
    cell.scope = "col"; cell.className = c.words ? "" : "num";
    button.type = "button"; button.textContent = c.name;
    button.addEventListener("click", () => { way = by === c ? -way : 1; by = c; list(); });
  }
  const cells = (i, row) => {
    for (const [n, c] of columns.entries()) {
      const value = c.value(i), cell = row.insertCell(), text = value === null ? "" : c.text ? c.text(value, i) : String(value);
      cell.className = c.words ? "message" : "num";
      if (n) { cell.textContent = text; continue; }
      const button = cell.appendChild(document.createElement("button"));
      button.type = "button"; button.textContent = text; button.dataset.case = value;
    }
    row.classList.toggle("on", i === chosen);
  };
  const extend = () => {
    const part = document.createDocumentFragment();
    for (const i of found.slice(rows, rows + PART)) cells(i, part.appendChild(document.createElement("tr")));
    body.append(part);
    rows = body.rows.length;
    more.hidden = rows >= found.length;
    more.textContent = `Show ${Math.min(PART, found.length - rows)} more`;
  };
  const filter = () => {
    const low = from.value === "" ? -Infinity : Number(from.value), high = to.value === "" ? Infinity : Number(to.value);
    const measured = columns.find(({ name }) => name === measure.value)?.value, bounded = measured && (low > -Infinity || high < Infinity);
    found = all.filter((i) => (!level.value || cases.level[i] === Number(level.value))
      && (!ended.value || verdict(i) === ended.value || `: ${message(i)}` === ended.value)
      && (!severe.value || severity(i) === severe.value) && (!region.value || where(i) === region.value) && (!kind.value || kindOf(i) === kind.value)
      && (!avoided?.value || avoidedBy(i, avoided.value))
      && (!bounded || (measured(i) !== null && measured(i) >= low && measured(i) <= high)));
    matching = filtersSet().length ? new Set(found) : null;
    list();
    for (const map of maps) region.value.startsWith(`${map.level}:`) ? map.showAll() : map.draw();
    for (const button of document.querySelectorAll("[data-filter]")) button.setAttribute("aria-pressed", form.elements[button.dataset.filter].value === button.dataset.value);
    byId("filtered").hidden = matching === null;
    byId("filtered-number").textContent = `${found.length} of ${all.length} cases match the filters. The others are faint.`;
    if (chosen >= 0) byId("case-link").href = address(chosen);
  };
  const list = () => {
    found.sort((a, b) => { // rows without a value are last in both directions
      const [x, y] = [a, b].map((i) => (by.value(i) === null ? null : (by.order ?? by.value)(i)));
      return (x === null) - (y === null) || (x < y ? -way : x > y ? way : a - b);
    });
    for (const [n, cell] of [...head.cells].entries()) {
      columns[n] === by ? cell.setAttribute("aria-sort", way > 0 ? "ascending" : "descending") : cell.removeAttribute("aria-sort");
    }
    byId("matching").textContent = matching ? `${found.length} of ${all.length} cases match the filters.` : "";
    body.replaceChildren();
    rows = 0;
    extend();
  };
  let typing = null; // one entry of the history for a number, not for each key
  const changed = (control = null) => {
    filter();
    history[control && control === typing ? "replaceState" : "pushState"](null, "", address());
    typing = control?.matches("input") ? control : null;
  };
  for (const control of form.elements) if (control.matches("select, input")) control.addEventListener("input", () => changed(control));
  form.addEventListener("change", () => { typing = null; });
  const reset = () => { form.reset(); changed(); };
  for (const button of document.querySelectorAll(".reset")) button.addEventListener("click", reset);
  for (const button of document.querySelectorAll("[data-filter]")) button.addEventListener("click", () => {
    const control = form.elements[button.dataset.filter], { value } = button.dataset;
    control.value = control.value === value ? "" : value;
    changed();
    document.querySelector(".map").scrollIntoView({ block: "nearest" });
  });
  form.addEventListener("submit", (event) => event.preventDefault());
  more.addEventListener("click", extend);
  body.addEventListener("click", (event) => {
    const row = event.target.closest("tr");
    if (row) openCase(found[row.sectionRowIndex], row);
  });
  body.addEventListener("keydown", (event) => {
    const row = event.target.closest("tr"), to = { ArrowDown: row?.nextElementSibling, ArrowUp: row?.previousElementSibling }[event.key];
    if (!to) return;
    event.preventDefault();
    to.querySelector("button").focus();
    openCase(found[to.sectionRowIndex], to);
  });
  byId("all").hidden = !all.length;
  return filter;
}
/* ---------- the search ---------- */
function search() {
  const { cases: numbers, levels } = data.search;
  const lines = levels.map(({ level, fmc }) => ({ name: `level${level}`, points: fmc.map((y, n) => [numbers[n], y]) }));
  const most = Math.max(...levels.flatMap(({ fmc }) => fmc), 0.001);
  plot(byId("chart-fmc"), { xRange: [0, numbers[numbers.length - 1]], xLabel: "cases", yRange: [0, 1.1 * most], lines });
}

const filter = allCases();
restore();
for (const map of maps) map.showAll();
search();
if (cases.index.length) filter();
if (!openLinked() && panel.dataset.first) show(place.get(Number(panel.dataset.first)));
