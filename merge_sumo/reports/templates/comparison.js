// A comparison around its player (player.js): the list of cases, and the marks of the maps.
const pairs = data.pairs, panel = byId("case"), buttons = [...document.querySelectorAll(".pairs button")];
const views_of = [...document.querySelectorAll(".view")], sides = [...document.querySelectorAll(".side")];

function show(n) {
  const pair = pairs[n];
  byId("case-title").textContent = pair.title;
  for (const [k, side] of pair.sides.entries()) {
    sides[k].querySelector("b").textContent = side.version;
    sides[k].querySelector("span").textContent = side.words;
    const replay = sides[k].querySelector("code");
    replay.textContent = side.replay;
    replay.hidden = !side.replay;
  }
  for (const button of buttons) button.closest("tr").classList.toggle("on", Number(button.dataset.pair) === n);
  for (const mark of document.querySelectorAll(".map [data-pair]")) mark.classList.toggle("on", Number(mark.dataset.pair) === n);
  const known = pair.sides.map((side) => ({ ...side, moves: motion(side.case) })).filter(({ moves }) => moves);
  byId("case-motion").hidden = !known.length;
  byId("lost").hidden = known.length === 2;
  play(false);
  if (!known.length) return;
  for (const [k, view] of views_of.entries()) {
    view.hidden = !known[k];
    if (known[k]) view.querySelector("figcaption").textContent = known[k].version;
  }
  const [earlier, later] = known.map(({ moves }) => moves);
  later ? animate(later, [], () => [], earlier) : animate(earlier, [], () => []);
  at(Math.min(moving.until, final));
}
function open(n) {
  show(n);
  history.replaceState(null, "", `#${pairs[n].name}`);
}
function linked() {
  const n = pairs.findIndex(({ name }) => `#${name}` === location.hash);
  if (n >= 0) show(n);
  return n >= 0;
}
for (const [n, button] of buttons.entries()) {
  button.closest("tr").addEventListener("click", () => open(Number(button.dataset.pair)));
  button.addEventListener("keydown", (event) => {
    const to = { ArrowDown: n + 1, ArrowUp: n - 1, Home: 0, End: buttons.length - 1 }[event.key];
    if (to === undefined || !buttons[to]) return;
    event.preventDefault();
    buttons[to].focus();
    open(Number(buttons[to].dataset.pair));
  });
}
for (const mark of document.querySelectorAll(".map [data-pair]")) mark.addEventListener("click", () => {
  open(Number(mark.dataset.pair));
  panel.scrollIntoView({ block: "nearest" });
});
addEventListener("hashchange", linked);
if (!linked()) show(0);
