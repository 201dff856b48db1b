// Days with many cars in one lot: settings side by side, on the same day and one clock.

/** What a car does until the next point of its track; 0: it drives, 3: it waits. */
const [FAILS, QUEUES] = [1, 2];
/** What is in a slot, if it is no car of the fleet. */
const [EMPTY, RESIDENT] = [-1, -2];
const MOST_DAYS = 2;
const KNOWS = {
  own: "own observations", shared: "a live map", reserve: "reserved slots", full: "the state of every slot",
};
/** How long the place where a car gave up is marked, s. */
const GONE_S = 20;
const SAMPLES = 300;

/** A day: where each car is, and which slots are taken, at any time. */
class FleetDay {
  constructor(recorded, lot) {
    this.recorded = recorded;
    this.lot = lot;
    this.duration = recorded.duration / 100;
    this.tracks = recorded.tracks.map((track, car) => {
      const points = (track.length - 1) / 2;
      const at = new Float64Array(points + 1);
      const vertex = new Int32Array(points + 1);
      const kind = new Uint8Array(points + 1);
      at[0] = recorded.arrival[car] / 100;
      vertex[0] = track[0];
      for (let i = 0; i < points; i += 1) {
        at[i + 1] = at[i] + track[2 * i + 1] / 100;
        vertex[i + 1] = track[2 * i + 2] >> 2;
        kind[i + 1] = track[2 * i + 2] & 3;
      }
      return { at, vertex, kind, now: 0, yaw: lot.yaw[track[0]] ?? 0 };
    });
    // Changes of slots: time, slot, and the car that parks, or -1.
    const changes = [];
    for (let i = 0; i < recorded.residents.length; i += 2) changes.push([recorded.residents[i + 1] / 100, recorded.residents[i], -1]);
    recorded.slot.forEach((slot, car) => {
      if (slot < 0) return;
      changes.push([recorded.ended[car] / 100, slot, car]);
      if (recorded.leaves[car] >= 0) changes.push([recorded.leaves[car] / 100, slot, -1]);
    });
    // At the same time, cars leave first.
    this.changes = changes.sort((a, b) => a[0] - b[0] || a[2] - b[2]);
    this.changeTimes = this.changes.map(([time]) => time);
    this.rewind();
    this.course = this.courseOfDay();
  }

  rewind() {
    this.applied = 0;
    this.slots = new Int32Array(this.lot.slots.length).fill(EMPTY);
    for (let i = 0; i < this.recorded.residents.length; i += 2) this.slots[this.recorded.residents[i]] = RESIDENT;
    this.taken = this.recorded.residents.length / 2;
  }

  /** Bring the slots to a time; returns those that changed, or null for all. */
  slotsAt(seconds) {
    const wanted = lastUpTo(this.changeTimes, seconds) + 1;
    let changed = [];
    if (wanted < this.applied) {
      this.rewind();
      changed = null;
    }
    for (; this.applied < wanted; this.applied += 1) {
      const [, slot, car] = this.changes[this.applied];
      this.taken += (car >= 0) - (this.slots[slot] !== EMPTY);
      this.slots[slot] = car >= 0 ? car : EMPTY;
      changed?.push(slot);
    }
    return changed;
  }

  /** Call draw(car, x, y, yaw, kind) for each searching car; arrivals are in order. */
  each(seconds, draw) {
    const { arrival, ended } = this.recorded;
    const last = lastUpTo(arrival, 100 * seconds);
    for (let car = 0; car <= last; car += 1) {
      if (ended[car] <= 100 * seconds) continue;
      const track = this.tracks[car];
      const { at, vertex, kind } = track;
      let i = track.now;
      if (at[i] > seconds) i = 0;
      while (i + 1 < at.length && at[i + 1] <= seconds) i += 1;
      track.now = i;
      const [ax, ay] = this.lot.vertices[vertex[i]];
      if (i + 1 >= at.length) {
        draw(car, ax, ay, track.yaw, QUEUES);
        continue;
      }
      const [bx, by] = this.lot.vertices[vertex[i + 1]];
      const share = (seconds - at[i]) / Math.max(at[i + 1] - at[i], 1e-6);
      if (vertex[i] !== vertex[i + 1]) track.yaw = Math.atan2(by - ay, bx - ax);
      else if (i > 0) {
        for (let k = i; k > 0; k -= 1) {
          if (vertex[k] === vertex[k - 1]) continue;
          const [px, py] = this.lot.vertices[vertex[k - 1]];
          track.yaw = Math.atan2(ay - py, ax - px);
          break;
        }
      }
      draw(car, ax + share * (bx - ax), ay + share * (by - ay), track.yaw, kind[i + 1]);
    }
  }

  /** Cars that gave up a short time ago, with the place and how long ago. */
  gone(seconds) {
    const { recorded } = this;
    this.leavers ??= recorded.slot.flatMap((slot, car) => (slot < 0 ? [[recorded.ended[car] / 100, this.tracks[car].vertex.at(-1)]] : [])).sort((a, b) => a[0] - b[0]);
    return this.leavers.filter(([time]) => time <= seconds && time > seconds - GONE_S).map(([time, vertex]) => [this.lot.vertices[vertex], (seconds - time) / GONE_S]);
  }

  /** Numbers of searching cars and taken slots at evenly spaced times. */
  courseOfDay() {
    const { arrival, ended } = this.recorded;
    const searching = new Array(SAMPLES + 1).fill(0);
    const taken = new Array(SAMPLES + 1).fill(0);
    const step = this.duration / SAMPLES || 1;
    arrival.forEach((time, car) => {
      const [from, to] = [time / 100, ended[car] / 100];
      for (let i = Math.ceil(from / step); i <= SAMPLES && i * step < to; i += 1) searching[i] += 1;
    });
    for (let i = 0; i <= SAMPLES; i += 1) {
      this.slotsAt(i * step);
      taken[i] = this.taken / this.lot.slots.length;
    }
    this.rewind();
    return { searching, taken, most: Math.max(...searching, 1) };
  }
}

/** Draws a day; slots and parked cars are on a layer of their own, on which only changed slots are painted again. */
class FleetView {
  constructor(canvas, day) {
    this.day = day;
    this.view = new LotView(canvas, day.lot);
    this.layer = null;
  }

  resize() {
    this.view.resize();
    this.layer = null;
  }

  colorOf(slot) {
    const car = this.day.slots[slot];
    if (car === RESIDENT) return palette.resident;
    return this.day.recorded.member[car] ? palette.member : palette.other;
  }

  paint(context, number) {
    const slot = this.view.slots[number];
    this.view.paintSlot(context, slot, palette.asphalt, 1, () => {
      if (this.day.slots[number] === EMPTY) return;
      this.view.carBody(context, this.colorOf(number), Math.min(0.78 * slot.length, 4.4), Math.min(0.6 * slot.width, 1.75));
    });
  }

  draw(seconds) {
    const { view, day } = this;
    const changed = day.slotsAt(seconds);
    if (!this.layer) this.layer = this.stillLayer();
    const still = this.layer.getContext("2d");
    view.toMetres(still);
    if (changed === null || changed.length > view.slots.length) for (let slot = 0; slot < view.slots.length; slot += 1) this.paint(still, slot);
    else for (const slot of changed) this.paint(still, slot);
    const { context } = view;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(this.layer, 0, 0);
    view.toMetres(context);
    view.drawGoal(...day.lot.goals[day.recorded.goal]);
    const counts = { searching: 0, failing: 0, queueing: 0 };
    const { member } = day.recorded;
    const { scale, x: midX, y: midY } = view.at;
    const k = view.ratio;
    day.each(seconds, (car, x, y, yaw, kind) => {
      counts.searching += 1;
      if (kind === FAILS) counts.failing += 1;
      if (kind === QUEUES) counts.queueing += 1;
      const sprite = this.sprites[kind === FAILS ? 1 : kind === QUEUES ? 2 : 0][member[car]];
      // Heading and place in pixels, where y points down.
      const [cos, sin] = [Math.cos(yaw), -Math.sin(yaw)];
      context.setTransform(cos, sin, -sin, cos, k * (view.width / 2 + scale * (x - midX)), k * (view.height / 2 - scale * (y - midY)));
      context.drawImage(sprite, -sprite.width / 2, -sprite.height / 2);
    });
    view.toMetres(context);
    for (const [[x, y], faded] of day.gone(seconds)) this.cross(context, x, y, 1 - faded);
    view.drawScale();
    return counts;
  }

  /** Paint the ground, all slots and parked cars, and make pictures of the moving cars. */
  stillLayer() {
    const { view } = this;
    view.begin();
    const layer = document.createElement("canvas");
    layer.width = view.canvas.width;
    layer.height = view.canvas.height;
    const still = layer.getContext("2d");
    still.drawImage(view.ground, 0, 0);
    view.toMetres(still);
    for (let slot = 0; slot < view.slots.length; slot += 1) this.paint(still, slot);
    this.sprites = [palette.car, palette.failed, palette.queue].map((body) => [palette.other, palette.member].map((roof) => this.sprite(body, roof)));
    return layer;
  }

  /** Make a picture of a car that heads to the right. */
  sprite(body, roof) {
    const { view } = this;
    const length = view.ratio * Math.max(4.4 * view.at.scale, 11);
    const width = 0.46 * length;
    const line = 1.2 * view.ratio;
    const canvas = document.createElement("canvas");
    canvas.width = Math.ceil(length + line + 1);
    canvas.height = Math.ceil(width + line + 1);
    const context = canvas.getContext("2d");
    context.translate(canvas.width / 2, canvas.height / 2);
    context.strokeStyle = "#1c2126";
    context.lineWidth = line;
    view.carBody(context, body, length, width);
    context.stroke();
    context.fillStyle = roof;
    context.fillRect(-0.26 * length, -0.27 * width, 0.36 * length, 0.54 * width);
    return canvas;
  }

  /** Mark the place where a car gave up its search. */
  cross(context, x, y, opacity) {
    const size = Math.max(2, this.view.px(5));
    context.globalAlpha = opacity;
    context.strokeStyle = palette.ink;
    context.lineWidth = this.view.px(2.4);
    context.beginPath();
    context.moveTo(x - size, y - size);
    context.lineTo(x + size, y + size);
    context.moveTo(x - size, y + size);
    context.lineTo(x + size, y - size);
    context.stroke();
    context.globalAlpha = 1;
  }
}

class FleetReplay {
  constructor(root, data) {
    this.root = root;
    this.data = data;
    const { fleets } = data;
    this.days = new Map();
    this.several = new Set(fleets.map((its) => its.scenario)).size > 1;
    this.groups = [...new Set(fleets.map((its) => this.groupOf(its)))];
    this.groupChoice = make("select", { id: "demand" }, ...this.groups.map((name) => make("option", { value: name }, name)));
    this.groupChoice.addEventListener("change", () => this.open(this.groupChoice.value));
    this.chips = make("div", { class: "chips", role: "group", "aria-label": `Settings, at most ${MOST_DAYS}` });
    this.panels = make("div", { class: "panels" });
    this.strips = make("div", { class: "strips" });
    const transport = make("div", { class: "card transport" });
    this.player = new Player(root, {
      name: "day", speeds: [1, 5, 10, 30, 60, 120, 300], speed: 10,
      show: (seconds) => this.show(seconds),
      describe: (seconds) => moment((this.shown?.[0].day.recorded.begin_s ?? 0) + seconds, ""),
    });
    transport.append(this.strips, this.player.keys);
    root.append(
      make("p", { class: "quiet" }, "Days of this run, simulated again. On the same day, all settings have the same arrivals, stays and residents. Cars come in at the green arrow, search, park, and leave after their stay."),
      make("div", { class: "controls" }, this.groups.length > 1 ? make("label", {}, "Day ", this.groupChoice) : null, this.chips),
      this.panels, transport, fleetLegend(fleets),
    );
    this.open(this.groups[0]);
    onNewWidth(root, () => this.redraw());
  }

  groupOf(its) {
    const rate = its.arrivals_per_hour;
    return `${this.several ? "" : `${its.scenario} · `}${typeof rate === "string" ? `demand ${rate}` : `${rate} cars an hour`} · day ${its.day}${its.date && !this.several ? `, ${its.date}` : ""}`;
  }

  /** Name of a setting within its day. */
  nameOf(its) {
    const agents = new Set(this.data.fleets.map((other) => other.agents)).size > 1;
    const share = its.share > 0 && its.share < 1 ? `, ${written(100 * its.share, 0)} % members` : "";
    return `${this.several ? `${its.scenario}, ` : ""}${agents ? `${shortName(its.agents)}, ` : ""}${its.knows}${share}`;
  }

  open(group) {
    const its = this.data.fleets.filter((other) => this.groupOf(other) === group);
    this.there = new Map(its.map((other) => [this.nameOf(other), other]));
    const names = [...this.there.keys()];
    const kept = (this.chosen ?? []).filter((name) => names.includes(name));
    const wanted = window.innerWidth < 720 ? 1 : MOST_DAYS;
    const most = Math.max(...its.map(({ share }) => share));
    const other = this.several ? names[1] : names.find((name, i) => i > 0 && its[i].knows === "reserve" && its[i].share === most) ?? names[1];
    this.chosen = kept.length ? kept : [names[0], other].filter(Boolean).slice(0, wanted);
    this.chips.replaceChildren(...names.map((name) => make("button", { type: "button", class: "chip", "data-setting": name, onclick: () => this.toggle(name) }, name)));
    this.layOut();
    // Begin when the lot is busiest.
    const [{ day }] = this.shown;
    const busiest = day.course.searching.indexOf(day.course.most);
    this.load((busiest / SAMPLES) * day.duration);
  }

  /** Load the chosen days, and go to a time; the keys step between full minutes. */
  load(seconds) {
    const duration = this.duration();
    this.player.load(duration, Array.from({ length: Math.floor(duration / 60) }, (_, i) => 60 * (i + 1)));
    this.player.goTo(seconds);
  }

  duration() {
    return Math.max(...this.shown.map(({ day }) => day.duration));
  }

  toggle(name) {
    const there = this.chosen.includes(name);
    if (there && this.chosen.length === 1) return;
    const others = this.chosen.filter((other) => other !== name);
    const chosen = there ? others : [...others.slice(0, MOST_DAYS - 1), name];
    this.chosen = [...this.there.keys()].filter((other) => chosen.includes(other));
    this.redraw();
  }

  dayOf(recorded) {
    if (!this.days.has(recorded)) this.days.set(recorded, new FleetDay(recorded, this.data.lots[recorded.lot]));
    return this.days.get(recorded);
  }

  layOut() {
    for (const chip of this.chips.children) chip.setAttribute("aria-pressed", String(this.chosen.includes(chip.dataset.setting)));
    const lot = this.data.lots[this.there.values().next().value.lot];
    const [x0, y0, x1, y1] = lot.bounds;
    const beside = window.innerWidth >= 720 && this.chosen.length > 1 && (x1 - x0) / (y1 - y0) < 2.6;
    this.panels.style.setProperty("--columns", beside ? 2 : 1);
    this.shown = this.chosen.map((name) => {
      const recorded = this.there.get(name);
      const day = this.dayOf(recorded);
      const canvas = make("canvas", { class: "lot", role: "img" });
      const clock = make("span", { class: "clock" });
      const counts = make("div", { class: "counts" });
      const who = recorded.share === 0 ? "nobody knows more than it observes" : `${recorded.share < 1 ? "members know" : "all know"}: ${KNOWS[recorded.knows]}`;
      const panel = make("article", { class: "card panel", "data-setting": name }, make("header", {}, make("h3", {}, name), make("span", { class: "status" }, who), clock), canvas, counts);
      return { name, day, canvas, clock, counts, panel };
    });
    this.panels.replaceChildren(...this.shown.map(({ panel }) => panel));
    for (const its of this.shown) {
      its.view = new FleetView(its.canvas, its.day);
      its.view.resize();
    }
    this.layCourses();
  }

  layCourses() {
    const duration = this.duration();
    const most = Math.max(...this.shown.map(({ day }) => day.course.most));
    const rows = this.shown.flatMap(({ name, day }) => {
      const { searching, taken } = day.course;
      const x = (i) => ((i / SAMPLES) * day.duration * 100) / duration;
      const line = (values, scale) => values.map((value, i) => `${x(i).toFixed(2)},${(98 - 92 * scale * value).toFixed(2)}`);
      const area = ["0,98", ...line(searching, 1 / most), `${x(SAMPLES).toFixed(2)},98`].join(" ");
      const svg = makeSvg("svg", { viewBox: "0 0 100 100", preserveAspectRatio: "none", role: "img", "aria-label": `${name}: searching cars, at most ${day.course.most}, and share of taken slots over the day` },
        makeSvg("line", { class: "full", x1: 0, x2: 100, y1: 6, y2: 6 }),
        makeSvg("polygon", { class: "searching", points: area }),
        makeSvg("polyline", { class: "taken", points: line(taken, 1).join(" ") }),
      );
      return [
        make("span", { class: "who", title: name }, name, make("small", {}, `at most ${day.course.most} searching`)),
        make("div", { class: "course" }, svg),
        make("span", { class: "total" }, `${seconds2(day.recorded.total_s)} s`, make("small", {}, "a car")),
      ];
    });
    if (window.innerWidth < 720) for (let i = 0; i < rows.length; i += 3) [rows[i + 1], rows[i + 2]] = [rows[i + 2], rows[i + 1]];
    this.playhead = make("div", { class: "playhead" });
    this.strips.replaceChildren(...rows, this.player.time, this.playhead);
    this.courses = [...this.strips.querySelectorAll(".course")];
  }

  /** Move the line through the courses to the current time. */
  movePlayhead(seconds) {
    const [first, last] = [this.courses[0], this.courses.at(-1)];
    const left = first.offsetLeft + (first.offsetWidth * seconds) / this.player.duration;
    const top = first.offsetTop - 3;
    this.playhead.style.cssText = `left: ${left}px; top: ${top}px; height: ${last.offsetTop + last.offsetHeight + 3 - top}px`;
  }

  redraw() {
    const { seconds } = this.player;
    this.layOut();
    this.load(seconds);
  }

  show(seconds) {
    if (!this.shown) return;
    this.movePlayhead(seconds);
    for (const { name, day, view, canvas, clock, counts } of this.shown) {
      const { searching, failing, queueing } = view.draw(Math.min(seconds, day.duration));
      const taken = day.taken / day.lot.slots.length;
      clock.textContent = moment(day.recorded.begin_s + seconds, day.recorded.date).slice(day.recorded.date ? 0 : 4);
      const words = [["searching", searching, "--car"], ["in a failed attempt", failing, "--failed"], ["in a queue", queueing, "--queue"]]
        .filter(([, count], i) => i < 2 || count > 0)
        .map(([text, count, color]) => make("span", {}, make("b", {}, String(count)), ` ${text}`));
      words.push(make("span", {}, make("b", {}, `${written(100 * taken, 0)} %`), " of the slots taken"));
      const { agrees, counted_s: counted } = day.recorded;
      if (agrees !== null) words.push(make("span", { class: agrees ? "check" : "check bad", title: "Whether the simulation reproduced the mean total time in days.csv" }, agrees ? "✓ as in days.csv" : `days.csv: ${seconds2(counted)} s`));
      counts.replaceChildren(...words);
      canvas.setAttribute("aria-label", `${name} at ${moment(day.recorded.begin_s + seconds, "")}: ${searching} searching, ${written(100 * taken, 0)} % of the slots taken`);
    }
  }
}

/** The legend of cars. */
function fleetLegend(fleets) {
  const body = (color, roof) => markSvg(26, makeSvg("rect", { x: 2, y: 3, width: 22, height: 10, rx: 3, style: `fill: var(${color}); stroke: #1c2126; stroke-width: 1.2` }), makeSvg("rect", { x: 7, y: 5, width: 8, height: 6, style: `fill: var(${roof})` }));
  const parked = (color) => markSvg(26, makeSvg("rect", { x: 2, y: 3, width: 22, height: 10, rx: 3, style: `fill: var(${color})` }));
  const cross = markSvg(16, makeSvg("path", { d: "M3 3l10 10M3 13l10-10", style: "stroke: var(--ink); stroke-width: 2.4" }));
  const goal = markSvg(16, makeSvg("circle", { cx: 8, cy: 8, r: 5, style: "fill: none; stroke: var(--goal); stroke-width: 4" }));
  const mixed = fleets.some((its) => its.share > 0);
  const queues = fleets.some((its) => its.tracks.some((track) => track.some((code, i) => i > 0 && i % 2 === 0 && (code & 3) === QUEUES)));
  const area = markSvg(24, makeSvg("rect", { x: 1, y: 5, width: 22, height: 9, style: "fill: var(--car)" }));
  const line = markSvg(24, makeSvg("path", { d: "M1 8H23", style: "stroke: var(--ink); stroke-width: 1.6" }));
  return make(
    "div", { class: "legend lot" },
    keyed(body("--car", "--other"), "searching"), mixed ? keyed(body("--car", "--member"), "searching member") : null,
    keyed(body("--failed", "--other"), "failed attempt"), queues ? keyed(body("--queue", "--other"), "in a queue") : null,
    keyed(parked("--other"), "parked"), mixed ? keyed(parked("--member"), "parked member") : null, keyed(parked("--resident"), "resident"),
    keyed(goal, "goal"), keyed(cross, "gave up"), keyed(area, "searching cars"), keyed(line, "slots taken, dashes 100 %"),
  );
}
