// A comparison around its player (player.js): the list of cases, and the marks of the maps.
const panel = byId("case"), buttons = [...document.querySelectorAll(".pairs button")];
const rows = buttons.map((button) => button.closest("tr"));
const figures = [...document.querySelectorAll(".view")], sides = [...document.querySelectorAll(".side")];

function show(n) { // case 2 n is of the earlier version, case 2 n + 1 of the later version
  byId("case-title").textContent = signed(rows[n].dataset.title);
  for (const [k, side] of sides.entries()) {
    const i = 2 * n + k, replay = side.querySelector("code");
    side.querySelector("b").textContent = `${cases.version[i]}: ${cases.result[i]}`;
    side.querySelector("ol").replaceChildren(...cases.events[i].map(([time, text]) => {
      const item = document.createElement("li"), button = item.appendChild(document.createElement("button"));
      button.type = "button";
      button.textContent = `${fixed(time, 1)} s`;
      button.addEventListener("click", () => { play(false); at(time / DT); });
      item.append(` ${text}`);
      return item;
    }));
    replay.textContent = cases.replay[i];
    replay.hidden = !cases.replay[i];
  }
  for (const row of rows) row.classList.toggle("on", row === rows[n]);
  for (const mark of document.querySelectorAll(".map [data-pair]")) mark.classList.toggle("on", Number(mark.dataset.pair) === n);
  const known = [2 * n, 2 * n + 1].map((i) => ({ version: cases.version[i], moves: motion(i) })).filter(({ moves }) => moves);
  byId("case-motion").hidden = !known.length;
  byId("lost").hidden = known.length === 2;
  play(false);
  if (!known.length) return;
  for (const [k, view] of figures.entries()) {
    view.hidden = !known[k];
    if (known[k]) view.querySelector("figcaption").textContent = known[k].version;
  }
  const [earlier, later] = known.map(({ moves }) => moves);
  later ? animate(later, [], () => [], earlier) : animate(earlier, [], () => []);
  at(Math.min(moving.until, final));
}
function open(n) {
  show(n);
  history.replaceState(null, "", `#${rows[n].id}`);
}
function linked() {
  const n = rows.findIndex(({ id }) => `#${id}` === location.hash);
  if (n >= 0) show(n);
  return n >= 0;
}
for (const [n, button] of buttons.entries()) {
  rows[n].addEventListener("click", () => open(n));
  button.addEventListener("keydown", (event) => {
    const to = { ArrowDown: n + 1, ArrowUp: n - 1, Home: 0, End: buttons.length - 1 }[event.key];
    if (to === undefined || !buttons[to]) return;
    event.preventDefault();
    buttons[to].focus();
    open(to);
  });
}
for (const mark of document.querySelectorAll(".map [data-pair]")) mark.addEventListener("click", () => {
  open(Number(mark.dataset.pair));
  panel.scrollIntoView({ block: "nearest" });
});
addEventListener("hashchange", linked);
if (!linked()) show(0);
