// The game: you drive a search, see what the car has seen, and then how the agents did in the same world.

const data = JSON.parse(document.getElementById("game-data").textContent);
unpackGame(data);
const { problem, worlds, terms } = data;
const { lot } = problem;
const part = (id) => document.getElementById(id);

/** Seconds of the search in a second of the game; the least ms of a step, so that a short press is one step; the most. */
const SPEED = 4;
const [LEAST_MS, MOST_MS] = [140, 700];
/** Pixels of a tap, and of the drag that steers. */
const [TAP, DRAG] = [10, 26];
/** Seconds after which the picture of a car that was seen has faded by two thirds. */
const FADES_S = 45;
const KEYS = { ArrowUp: 0, ArrowDown: 1, ArrowLeft: 2, ArrowRight: 3, w: 0, s: 1, a: 2, d: 3 };
const still = matchMedia("(prefers-reduced-motion: reduce)");
const touch = matchMedia("(pointer: coarse)").matches;
const colors = () => [palette.car, palette.member, palette.queue, palette.entry, palette.other];

const canvas = part("lot");
const view = new LotView(canvas, lot, { fill: true });
const played = [];
const finished = () => played.length === worlds.length;
/** The search; what comes next: an action that is asked for, is held, or a route; and where the car is between vertices. */
let search, queued, held, route, aim, motion, heading;
/** What is shown after a search: its number, the drivers, and the player of their drives. */
let shown = null;

const slotName = (slot) => lot.slot_ids[slot] || `slot ${slot + 1}`;
const isSlot = (vertex) => vertex >= 0 && vertex < search.n;

/** Return the action of a direction on the screen, in which north may be left. */
const onScreen = (direction) => (view.turned ? [3, 2, 0, 1][direction] : direction);

function say(text, bad = false) {
  part("say").textContent = text;
  part("say").classList.toggle("bad", bad);
}

function begin() {
  const world = worlds[played.length];
  search = new GameSearch(problem, world, terms);
  [queued, held, route, aim, motion, heading] = [null, null, "", null, null, lot.yaw[world.entry] ?? 0];
  say(`${moment(world.arrival_s, world.day)}. Find a slot and walk to the goal, as fast as you can.`);
  drive();
}

// ---- driving

/** Take an action, and show it at SPEED. */
function act(action) {
  const [from, before, attempts] = [search.vertex, search.elapsed, search.costs.failed_s];
  search.step(action);
  if (search.vertex !== from) {
    const [[ax, ay], [bx, by]] = [lot.vertices[from], lot.vertices[search.vertex]];
    heading = Math.atan2(by - ay, bx - ax);
    if (search.actions.length < 3) say("");
  }
  const failed = search.costs.failed_s > attempts;
  if (failed) say(`${slotName(from)} is taken: ${Number(seconds2(search.costs.failed_s - attempts))} s lost`, true);
  part("clock").classList.toggle("costly", failed);
  const lasts = Math.min(Math.max((1000 * (search.elapsed - before)) / SPEED, LEAST_MS), MOST_MS);
  motion = { from, before, begun: performance.now(), lasts, share: 0 };
  requestAnimationFrame(onFrame);
}

function onFrame(now) {
  if (!motion) return;
  motion.share = Math.max(0, (now - motion.begun) / motion.lasts);
  if (motion.share < 1) {
    if (!still.matches) draw();
    requestAnimationFrame(onFrame);
    return;
  }
  motion = null;
  if (search.over) finish();
  else if (!goOn()) refresh();
}

/** Take the next action, if there is one; return whether there is. */
function goOn() {
  if (motion || shown || search.over) return false;
  const wanted = queued ?? held;
  queued = null;
  if (wanted === PARK ? isSlot(search.vertex) : search.target(wanted ?? PARK) >= 0) {
    [route, aim] = ["", null];
    if (wanted === PARK) held = null;
    act(wanted);
  } else if (route) {
    const action = Number(route[0]);
    route = route.slice(1);
    act(action);
  } else return false;
  refresh();
  return true;
}

/** Take an action, after the one that is shown. */
function ask(action) {
  queued = action;
  goOn();
}

/** Drive in a direction of the screen until another is given, or none. */
function steer(direction) {
  held = direction === null ? null : onScreen(direction);
  if (held !== null) ask(held);
}

/** Return a move without an edge, which waits. */
const waiting = () => [0, 1, 2, 3].find((action) => search.target(action) < 0);

function wait() {
  if (motion || shown || waiting() === undefined) return;
  say("");
  act(waiting());
  refresh();
}

/** Drive to the slot or crossing nearest to a place; park if the car is there, and the slot likely free. */
function go(place) {
  const distance = (i) => Math.min(...[lot.vertices[i], view.slots[i]].filter(Boolean).map((p) => Math.hypot((p.x ?? p[0]) - place[0], (p.y ?? p[1]) - place[1])));
  const goal = lot.vertices.reduce((best, _, i) => (distance(i) < distance(best) ? i : best), 0);
  if (goal === search.vertex && !motion) {
    if (isSlot(goal) && search.belief(goal) < 0.5) ask(PARK);
    return;
  }
  const found = search.route(goal);
  if (found === null) say("No lane leads there.");
  else [route, aim, held] = [found, goal, null];
  if (!goOn()) draw();
}

// ---- input

let pressed = null;
const at = (event) => [event.offsetX, event.offsetY];
canvas.addEventListener("pointerdown", (event) => {
  pressed = { at: at(event), steers: false };
  canvas.setPointerCapture(event.pointerId);
});
canvas.addEventListener("pointermove", (event) => {
  const [x, y] = at(event);
  if (!pressed) {
    hover(view.at && !shown && event.pointerType === "mouse" ? view.toPlace([x, y]) : null);
    return;
  }
  const [dx, dy] = [x - pressed.at[0], y - pressed.at[1]];
  if (shown || Math.hypot(dx, dy) < DRAG) return;
  // The stick's middle follows the finger, so that a turn back is as short as the first move.
  pressed = { at: [x - (DRAG * dx) / Math.hypot(dx, dy), y - (DRAG * dy) / Math.hypot(dx, dy)], steers: true };
  steer(Math.abs(dx) > Math.abs(dy) ? (dx > 0 ? 3 : 2) : dy > 0 ? 1 : 0);
});
for (const name of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(name, (event) => {
    const was = pressed;
    pressed = null;
    if (!was || shown) return;
    if (was.steers) steer(null);
    else if (name === "pointerup" && Math.hypot(at(event)[0] - was.at[0], at(event)[1] - was.at[1]) < TAP) go(view.toPlace(at(event)));
  });
}
let hovered = null;
canvas.addEventListener("pointerleave", () => hover(null));
function hover(place) {
  const before = hovered;
  hovered = place && view.slots.findIndex((slot) => Math.hypot(slot.x - place[0], slot.y - place[1]) < slot.width / 2);
  if (hovered !== before && !motion) draw();
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const onButton = event.target.closest?.("button, select, input");
  if (shown) {
    if (key === "Enter" && !onButton) part("result").querySelector(".first")?.click();
    return;
  }
  if (key in KEYS) {
    if (!event.repeat) steer(KEYS[key]);
  } else if (key === " " && !event.repeat) ask(PARK);
  else if (key === ".") wait();
  else if (key === "z") part("zoom").click();
  else return;
  event.preventDefault();
});
document.addEventListener("keyup", (event) => {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (key in KEYS && held === onScreen(KEYS[key])) steer(null);
});
window.addEventListener("blur", () => steer(null));
part("park").addEventListener("click", () => ask(PARK));
part("wait").addEventListener("click", wait);
part("zoom").addEventListener("click", () => {
  view.follow = !view.follow;
  part("zoom").setAttribute("aria-pressed", String(view.follow));
  view.ground = null;
  redraw();
});

// ---- what is seen

/** Say what is known of a slot. */
function known(slot) {
  if (!search.seen(slot)) return `forecast: ${Math.round(100 * search.belief(slot))} % taken`;
  const age = search.elapsed - search.observedAt[slot];
  return `${search.observedTaken[slot] ? "taken" : "free"}, seen ${age < 0.05 ? "now" : `${age.toFixed(0)} s ago`}`;
}

function draw() {
  const share = motion ? motion.share : 1;
  const [[ax, ay], [bx, by]] = [lot.vertices[motion ? motion.from : search.vertex], lot.vertices[search.vertex]];
  const here = [ax + share * (bx - ax), ay + share * (by - ay)];
  const elapsed = motion ? motion.before + share * (search.elapsed - motion.before) : search.elapsed;
  part("clock").replaceChildren(seconds2(elapsed), make("small", {}, " s"));
  view.begin(here);
  view.drawView(...here, problem.view_range_m);
  const car = (i) => 0.35 + 0.65 * Math.exp(-(search.elapsed - search.observedAt[i]) / FADES_S);
  const sawCar = (i) => search.seen(i) && search.observedTaken[i];
  view.drawSlots((i) => (sawCar(i) ? -1 : Math.round(255 * search.belief(i))), (i) => search.seen(i), (i) => (sawCar(i) ? car(i) : 0));
  view.drawLine([...search.record.vertex.slice(0, motion ? -1 : undefined).map((v) => lot.vertices[v]), here], palette.car, 3);
  let v = search.vertex;
  const ahead = [...route].map((action) => lot.vertices[(v = search.target(Number(action), v))]);
  view.drawLine([here, ...(motion ? [lot.vertices[search.vertex]] : []), ...ahead], palette.ink, 2, [3, 5]);
  view.drawGoal(...lot.goals[problem.goal]);
  const near = !motion && isSlot(search.vertex) ? search.vertex : null;
  const marked = route && isSlot(aim) ? aim : near;
  if (marked !== null) view.outline(view.slots[marked], palette.ink, 3);
  view.drawCar(...here, heading);
  const named = hovered !== null && hovered >= 0 ? hovered : marked;
  // The name stands above the slot and the car beside it.
  const top = (place) => view.toPixels([place.x, place.y])[1];
  const car0 = { x: here[0], y: here[1] };
  if (named !== null) view.drawName(named === near && top(car0) < top(view.slots[named]) ? car0 : view.slots[named], `${slotName(named)} · ${known(named)}`);
  part("say").classList.toggle("low", top(car0) < view.height / 2);
}

/** Show the state of the game: the lot, the keys, the worlds. */
function refresh() {
  draw();
  const slot = isSlot(search.vertex) ? search.vertex : null;
  const free = slot !== null && search.seen(slot) && !search.observedTaken[slot];
  part("park").disabled = slot === null;
  part("park").classList.toggle("free", free);
  const walk = slot === null ? "" : `${known(slot).split(",")[0]} · walk ${problem.walk_s[slot].toFixed(0)} s`;
  part("park").replaceChildren(slot === null ? "Park" : `Park in ${slotName(slot)}`, make("small", {}, walk || "beside a slot"));
  part("wait").disabled = waiting() === undefined;
  part("wait").replaceChildren("Wait", make("small", {}, waiting() === undefined ? "not here" : `${Number(seconds2(problem.seconds[5 * search.vertex + waiting()]))} s`));
  part("worlds").replaceChildren(
    ...worlds.map((_, i) => make("button", {
      type: "button", class: played[i] && "done", disabled: !played[i], "aria-label": `World ${i + 1}`,
      "aria-current": i === (shown ? shown.number : played.length) ? "true" : null, onclick: () => showResult(i),
    }, String(i + 1))),
  );
  canvas.dataset.steps = motion ? "" : search.actions.length;
  canvas.setAttribute("aria-label", `The car park from above; the car is ${slot === null ? "between slots" : `at ${slotName(slot)}, ${known(slot)}`}`);
}

function redraw() {
  if (shown) shown.player.goTo(shown.player.seconds);
  else if (search) draw();
}

// ---- after a search

function finish() {
  played.push(search);
  showResult(played.length - 1);
}

/** Return you and the agents in a world, each with its search and its drive over time. */
function driversOf(number) {
  const agents = problem.agents.map((name, i) => [name, new GameSearch(problem, worlds[number], terms).take(worlds[number].actions[i])]);
  return [["you", played[number]], ...agents].map(([name, its], i) => (
    { name, search: its, color: i, track: new Track(its.recording(name), { forecast: new Uint8Array(its.n) }, lot) }
  ));
}

function showResult(number) {
  shown?.player.pause();
  const drivers = driversOf(number);
  const root = make("div");
  const player = new Player(root, {
    name: "search", speeds: [2, 5, 10, 20], speed: 10,
    show: (seconds) => drawReplay(drivers, worlds[number], seconds),
    describe: (seconds) => `${seconds2(seconds)} s`,
  });
  shown = { number, player, drivers };
  active = player;
  part("keys").hidden = true;
  say("");
  const [mine] = drivers;
  const regret = mine.search.total - worlds[number].bound_s;
  const ended = mine.search.parked ? `You parked in ${slotName(mine.search.vertex)}` : mine.search.truncated ? "You ran out of steps" : "The lot is full, and you gave up";
  const headline = regret < 0.05 ? `${seconds2(mine.search.total)} s. Nobody could be faster.` : `${seconds2(mine.search.total)} s, ${seconds2(regret)} s more than possible`;
  const seconds = Math.max(...drivers.map((its) => its.search.total));
  root.append(
    make("h2", {}, headline),
    make("p", { class: "quiet" }, `${ended}. Now you see every car, and the drives of all in this world.`),
    make("div", { class: "strips" }, ...drivers.flatMap((its) => strip(its, seconds)), player.time),
    termLegend(drivers), player.keys,
    make("div", { class: "go" },
      finished() ? null : make("button", { type: "button", class: "first", onclick: proceed }, search.over ? `World ${played.length + 1}` : `Back to world ${played.length + 1}`),
      make("button", { type: "button", class: finished() ? "first" : null, onclick: save }, "Save scores")),
    table(number),
    make("p", { class: "quiet" }, "Regret: seconds above the clairvoyant bound. This command checks saved scores and compares them; --agents takes any others, too:"),
    make("code", {}, `parkenv compare --scenario ${problem.scenario} --seed ${worlds[0].seed} -n ${played.length} --agents belief,human:scores.json,oracle`),
  );
  part("result").replaceChildren(root);
  part("result").hidden = false;
  part("result").scrollTop = 0;
  refresh();
  player.load(seconds, drivers.map((its) => its.search.total));
  if (still.matches) player.goTo(seconds);
  else player.play();
}

/** Go on with the search that was begun, or with the next world. */
function proceed() {
  if (search.over) begin();
  else drive();
}

/** Leave the results, and let the search go on. */
function drive() {
  shown?.player.pause();
  [shown, active] = [null, null];
  part("result").hidden = true;
  part("keys").hidden = false;
  refresh();
}

/** Return the name of a driver, the parts of its total time, and the total. */
function strip({ name, search: its, color }, seconds) {
  const parts = make("div", { class: "strip" });
  let from = 0;
  for (const term of terms) {
    const cost = its.costs[term.field];
    parts.append(make("span", { style: `left: ${(100 * from) / seconds}%; width: ${(100 * cost) / seconds}%; background: ${termColor(term)}`, title: `${term.label} ${seconds2(cost)} s` }));
    from += cost;
  }
  return [
    make("span", { class: "who", title: name }, make("i", { style: `background: ${colors()[color % 5]}` }), shortName(name)),
    parts, make("span", { class: "total" }, `${seconds2(its.total)} s`),
  ];
}

function termLegend(drivers) {
  const used = terms.filter((term) => drivers.some((its) => its.search.costs[term.field] > 0));
  return make("div", { class: "legend" }, ...used.map((term) => keyed(make("i", { class: "swatch", style: `background: ${termColor(term)}` }), term.label)));
}

/** Return the table of the worlds so far, with means. */
function table(number) {
  const rows = played.map((its, i) => ({ i, totals: driversOf(i).map((driver) => driver.search.total), bound: worlds[i].bound_s }));
  const mean = (values) => values.reduce((a, b) => a + b, 0) / values.length;
  const cells = (name, totals, regret) => [make("th", { scope: "row" }, name), ...totals.map((total) => make("td", {}, seconds2(total))), make("td", {}, regret)];
  const regrets = rows.map((row) => row.totals[0] - row.bound);
  const body = rows.map((row, k) => make("tr", { "aria-current": row.i === number ? "true" : null }, ...cells(String(row.i + 1), row.totals, written(regrets[k], 1))));
  if (rows.length > 1) {
    const columns = rows[0].totals.map((_, c) => mean(rows.map((row) => row.totals[c])));
    const spread = Math.sqrt(mean(regrets.map((x) => (x - mean(regrets)) ** 2)) / (rows.length - 1));
    const half = spread * (problem.t95[rows.length - 2] ?? 1.96);
    body.push(make("tr", { class: "mean" }, ...cells("Mean", columns, `${written(mean(regrets), 1)} ± ${written(half, 1)}`)));
  }
  const names = ["World", "you", ...problem.agents.map(shortName), "regret"];
  return make("div", { class: "scroll" }, make("table", {}, make("thead", {}, make("tr", {}, ...names.map((name) => make("th", { scope: "col" }, name)))), make("tbody", {}, ...body)));
}

/** Draw all drivers at a time since the arrival, among the cars that are really there. */
function drawReplay(drivers, world, seconds) {
  const inCars = drivers.map(({ search: its, track }) => ({ its, track, k: track.at(seconds), parked: its.parked && seconds >= track.end - 0.005 }));
  const goal = lot.goals[problem.goal];
  part("clock").replaceChildren(make("small", {}, "replay "), seconds2(seconds), make("small", {}, " s"));
  view.begin(track0(inCars[0], seconds));
  const taken = (i) => isTaken(world, i, world.arrival_s + seconds);
  view.drawSlots((i) => (taken(i) ? -1 : 0), () => true, taken);
  // The first driver's line is the widest and lowest, so that all lines show on the same lane.
  inCars.forEach(({ its, track, k, parked }, i) => {
    const slot = parked && view.slots[its.vertex];
    const end = parked ? [slot.x, slot.y] : track.pose(Math.min(seconds, track.end), k);
    view.drawLine([...track.search.vertex.slice(0, k + 1).map((v) => lot.vertices[v]), end.slice(0, 2)], colors()[i % 5], 3 + 2.5 * (inCars.length - 1 - i));
    if (parked) view.drawLine([end, goal], colors()[i % 5], 2, [5, 4]);
  });
  view.drawGoal(...goal);
  inCars.reverse().forEach(({ its, track, k, parked }, back) => {
    const color = colors()[(inCars.length - 1 - back) % 5];
    const slot = parked && view.slots[its.vertex];
    view.drawCar(...(parked ? [slot.x, slot.y, slot.yaw] : track.pose(Math.min(seconds, track.end), k)), color, 13);
    const walked = parked ? Math.min((seconds - track.end) / Math.max(its.costs.walk_s, 0.01), 1) : 1;
    if (walked < 1) view.drawDot(slot.x + walked * (goal[0] - slot.x), slot.y + walked * (goal[1] - slot.y), 5, color);
  });
}

/** Return where a driver is, for the view that follows. */
const track0 = ({ track, k }, seconds) => track.pose(Math.min(seconds, track.end), k);

/** Save the actions of all finished worlds. */
function save() {
  const done = played.map(({ world, actions, total }) => ({ seed: world.seed, arrival_s: world.arrival_s, entry: world.entry, actions, total_s: total }));
  const text = JSON.stringify({ format: "parkenv-scores", version: 1, scenario: problem.scenario, worlds: done }, null, 1);
  const link = make("a", { href: URL.createObjectURL(new Blob([`${text}\n`], { type: "application/json" })), download: "scores.json" });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

// ---- the page

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  palette.read();
  view.ground = null;
  redraw();
}

const dark = matchMedia("(prefers-color-scheme: dark)");
setTheme(dark.matches ? "dark" : "light");
dark.addEventListener("change", () => setTheme(dark.matches ? "dark" : "light"));
part("theme").addEventListener("click", () => setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));

const scale = (opacity) => make("span", { class: "scale", style: `background: linear-gradient(90deg, var(--belief)); opacity: ${opacity}` });
const dot = markSvg(16, makeSvg("circle", { cx: 8, cy: 8, r: 6.5, style: "fill: var(--goal)" }), makeSvg("circle", { cx: 8, cy: 8, r: 2.4, style: "fill: var(--halo)" }));
const box = (color) => markSvg(18, makeSvg("rect", { x: 1, y: 3, width: 16, height: 10, rx: 3, style: `fill: ${color}` }));
part("legend").append(
  make("span", { class: "hint" }, touch ? "Tap a slot to drive there, then park. Dragging steers." : "Arrow keys or WASD drive, or click where to go; space parks."),
  keyed(box("var(--car)"), "you"), keyed(dot, "goal"), keyed(make("span", {}, "forecast free ", scale(0.5)), "taken"), keyed(box("#10907f"), "seen free"), keyed(box("var(--parked)"), "seen taken"),
);
new ResizeObserver(() => {
  // The lot does not turn between a search and its results.
  view.turns = !shown;
  view.resize();
  view.ground = null;
  redraw();
}).observe(canvas);
view.follow = view.whole.scale < 2.6;
part("zoom").setAttribute("aria-pressed", String(view.follow));
begin();

/** For scripts: how a search by some actions ends, and where a place, m, is on the canvas, px. */
window.game = {
  take: (number, actions) => new GameSearch(problem, worlds[number], terms).take(actions).state,
  toPixels: (place) => view.toPixels(place),
};
