// Searches: agents side by side in the same world, on one clock.

const MOST_PANELS = 4;

/** The true occupancy of a world over time. */
class Truth {
  constructor(world, slots) {
    this.world = world;
    this.slots = slots;
    this.times = world.changes.map((change) => change[0]);
    this.rewind();
  }

  rewind() {
    this.applied = 0;
    this.taken = new Uint8Array(this.slots);
    for (const slot of this.world.taken) this.taken[slot] = 1;
  }

  at(centiseconds) {
    const wanted = lastUpTo(this.times, centiseconds) + 1;
    if (wanted < this.applied) this.rewind();
    for (; this.applied < wanted; this.applied += 1) {
      for (const slot of this.world.changes[this.applied].slice(1)) this.taken[slot] ^= 1;
    }
    return this.taken;
  }
}

class SearchReplay {
  constructor(root, data) {
    this.data = data;
    const { worlds } = data;
    this.worldChoice = make("select", { id: "world" }, ...worlds.map((world, i) => make("option", { value: i }, this.worldName(world))));
    this.worldChoice.addEventListener("change", () => this.open(Number(this.worldChoice.value)));
    this.chips = make("div", { class: "chips", role: "group", "aria-label": `Agents, at most ${MOST_PANELS}` });
    this.followKey = make("button", { type: "button", class: "chip", "aria-pressed": "false" }, "Follow the car");
    this.followKey.addEventListener("click", () => {
      this.follow = !this.follow;
      this.layOut();
      this.player.goTo(this.player.seconds);
    });
    this.panels = make("div", { class: "panels" });
    this.strips = make("div", { class: "strips" });
    const transport = make("div", { class: "card transport" });
    this.player = new Player(root, {
      name: "search", speeds: [1, 2, 5, 10, 20, 50], speed: 5,
      show: (seconds) => this.show(seconds),
      describe: (seconds) => `${seconds2(seconds)} of ${seconds2(this.player.duration)} s`,
    });
    transport.append(this.strips, this.player.keys);
    const world = make("label", {}, "World ", this.worldChoice);
    const seeds = [...new Set(worlds.map((its) => its.seed))].sort((a, b) => a - b);
    const which = `${seeds.length > 1 ? "Seeds" : "Seed"} ${seeds.join(", ")} of this run, simulated again: `;
    root.append(
      make("p", { class: "quiet" }, `${which}under one seed every agent meets the same cars at the same times. Slot colours show the agent's belief, cars the true occupancy, which agents observe only nearby.`),
      make("div", { class: "controls" }, world, this.chips, this.followKey),
      this.panels, transport, lotLegend(),
    );
    // Follow the car if the whole lot would be too small.
    const lot = data.lots[worlds[0].lot];
    this.follow = Math.min(root.clientWidth, 1280) / (lot.bounds[2] - lot.bounds[0]) < 2.6;
    this.open(0);
    onNewWidth(root, () => this.redraw());
  }

  worldName(world) {
    const setting = world.setting;
    const its = this.data.worlds.map((other) => other.setting);
    const varies = (key) => new Set(its.map((s) => s[key])).size > 1;
    const parts = [world.scenario, moment(world.arrival_s, world.day)];
    if (varies("failure_cost_s")) parts.push(`failure cost ${setting.failure_cost_s} s`);
    if (varies("v_walk_kmh")) parts.push(`walk ${setting.v_walk_kmh} km/h`);
    if (varies("v_drive_kmh")) parts.push(`drive ${setting.v_drive_kmh} km/h`);
    parts.push(`seed ${world.seed}`);
    return parts.join(" · ");
  }

  open(number) {
    this.world = this.data.worlds[number];
    this.lot = this.data.lots[this.world.lot];
    this.truth = new Truth(this.world, this.lot.slots.length);
    const names = this.world.searches.map((search) => search.agent);
    const kept = (this.chosen ?? []).filter((name) => names.includes(name));
    this.chosen = kept.length ? kept : names.slice(0, window.innerWidth < 720 ? 1 : 2);
    this.chips.replaceChildren(
      ...names.map((name) => make("button", { type: "button", class: "chip", "data-agent": name, onclick: () => this.toggleAgent(name), title: name }, shortName(name))),
    );
    this.layOut();
    this.reload(0);
  }

  toggleAgent(name) {
    const there = this.chosen.includes(name);
    if (there && this.chosen.length === 1) return;
    if (!there && this.chosen.length === MOST_PANELS) return;
    const names = this.world.searches.map((search) => search.agent);
    this.chosen = names.filter((other) => (other === name ? !there : this.chosen.includes(other)));
    const seconds = this.player.seconds;
    this.layOut();
    this.reload(seconds);
  }

  reload(seconds) {
    const tracks = this.shown.map(({ track }) => track);
    const duration = Math.max(...tracks.map((track) => track.search.total_s));
    const stops = tracks.flatMap((track) => [...track.search.t.map((t) => t / 100), track.search.total_s]);
    this.player.load(duration, stops);
    this.layStrips(duration);
    this.player.goTo(seconds);
  }

  layOut() {
    const [x0, y0, x1, y1] = this.lot.bounds;
    const n = this.chosen.length;
    const wide = (x1 - x0) / (y1 - y0) > 1.9;
    const columns = window.innerWidth < 720 || n === 1 ? 1 : n === 3 && !wide ? 3 : 2;
    this.panels.style.setProperty("--columns", columns);
    this.followKey.setAttribute("aria-pressed", String(this.follow));
    for (const chip of this.chips.children) {
      const on = this.chosen.includes(chip.dataset.agent);
      chip.setAttribute("aria-pressed", String(on));
      chip.disabled = !on && n === MOST_PANELS;
    }
    this.shown = this.chosen.map((name) => {
      const search = this.world.searches.find((other) => other.agent === name);
      const canvas = make("canvas", { role: "img" });
      const status = make("span", { class: "status" });
      const clock = make("span", { class: "clock" });
      const split = make("div", { class: "split" });
      const panel = make("article", { class: "card panel", "data-agent": name }, make("header", {}, make("h3", { title: name }, shortName(name)), status, clock), canvas, split);
      return { track: new Track(search, this.world, this.lot), canvas, status, clock, split, panel };
    });
    this.panels.replaceChildren(...this.shown.map(({ panel }) => panel));
    for (const its of this.shown) {
      its.view = new LotView(its.canvas, this.lot);
      its.view.follow = this.follow;
      its.view.resize();
    }
  }

  layStrips(duration) {
    const rows = this.shown.flatMap(({ track }) => {
      const { search } = track;
      const strip = make("div", { class: "strip", title: data.terms.map(({ label }) => label).join(", ") });
      const part = (from, to, color) => {
        if (to > from) strip.append(make("span", { style: `left: ${(100 * from) / duration}%; width: ${(100 * (to - from)) / duration}%; background: ${color}` }));
      };
      let from = 0;
      let failing = false;
      search.t.forEach((t, k) => {
        const fails = k + 1 < search.t.length && search.failed[k + 1] > search.failed[k];
        if (k === search.t.length - 1 || fails !== failing) {
          part(from, t / 100, failing ? "var(--failed)" : "var(--drive)");
          [from, failing] = [t / 100, fails];
        }
      });
      let end = track.end;
      for (const term of termsAfterDrive()) part(end, (end += search.costs[term.field]), termColor(term));
      if (search.replans && search.t.length < 500) {
        search.plan.forEach((plan, k) => {
          if (plan !== null && k > 0 && plan.length) strip.append(make("span", { class: "replan", style: `left: ${search.t[k] / duration}%` }));
        });
      }
      const total = make("span", { class: "total" }, `${seconds2(search.total_s)} s`);
      return [make("span", { class: "who", title: search.agent }, shortName(search.agent)), strip, total];
    });
    // On a phone the name and the total stand above the strip.
    if (window.innerWidth < 720) for (let i = 0; i < rows.length; i += 3) [rows[i + 1], rows[i + 2]] = [rows[i + 2], rows[i + 1]];
    this.playhead = make("div", { class: "playhead" });
    this.strips.replaceChildren(...rows, this.player.time, this.playhead);
  }

  /** Move the line through all strips to the current time. */
  movePlayhead(seconds) {
    const strips = this.strips.querySelectorAll(".strip");
    if (!strips.length || !this.playhead) return;
    const [first, last] = [strips[0], strips[strips.length - 1]];
    const left = first.offsetLeft + (first.offsetWidth * seconds) / this.player.duration;
    const top = first.offsetTop - 3;
    this.playhead.style.cssText = `left: ${left}px; top: ${top}px; height: ${last.offsetTop + last.offsetHeight + 3 - top}px`;
  }

  redraw() {
    const seconds = this.player.seconds;
    this.layOut();
    this.layStrips(this.player.duration);
    this.player.goTo(seconds);
  }

  show(seconds) {
    if (!this.shown) return;
    this.movePlayhead(seconds);
    const taken = this.truth.at(Math.round(100 * seconds));
    for (const { track, view, canvas, status, clock, split, panel } of this.shown) {
      const { search } = track;
      const k = track.at(seconds);
      const [x, y, yaw] = track.pose(Math.min(seconds, track.end), k);
      const parked = search.parked && seconds >= track.end - 0.005;
      const over = seconds >= search.total_s - 0.005;
      const goal = this.lot.goals[this.world.goal];
      const slot = search.parked ? view.slots[search.slot] : null;
      const walked = parked ? Math.min((seconds - track.end) / Math.max(search.costs.walk_s, 0.01), 1) : 0;
      const walker = parked ? [slot.x + walked * (goal[0] - slot.x), slot.y + walked * (goal[1] - slot.y)] : null;
      view.begin(walker ?? [x, y]);
      if (!parked) view.drawView(x, y, this.world.view_range_m);
      view.drawSlots((i) => track.belief[i], (i) => track.seen[i], (i) => taken[i] && !(parked && i === search.slot));
      const trail = search.vertex.slice(0, k + 1).map((v) => this.lot.vertices[v]);
      if (!parked) trail.push([x, y]);
      else trail.push([slot.x, slot.y]);
      view.drawLine(trail, palette.car, 3);
      if (!parked && k < track.plans.length && seconds < track.end) {
        const plan = track.plans[k];
        const end = plan[plan.length - 1];
        view.drawPlan([[x, y], ...plan.map((v) => this.lot.vertices[v])], end < view.slots.length ? end : null);
      }
      if (parked) view.drawLine([[slot.x, slot.y], goal], palette.goal, 2, [5, 4]);
      view.drawGoal(...goal);
      if (parked) {
        view.drawCar(slot.x, slot.y, slot.yaw);
        if (!over) view.drawDot(...walker, 5, palette.goal);
      } else view.drawCar(x, y, yaw);
      const plan = track.plans[k] ?? [];
      const aim = parked ? search.slot : plan[plan.length - 1];
      if (aim < view.slots.length) view.drawName(view.slots[aim], this.lot.slot_ids[aim]);
      view.drawScale();

      const parts = track.split(seconds, k);
      const statusText = track.status(seconds, k);
      status.textContent = statusText;
      clock.replaceChildren(seconds2(Math.min(seconds, search.total_s)), make("small", {}, " s"));
      panel.classList.toggle("done", over);
      panel.dataset.vertex = search.vertex[k];
      panel.dataset.total = search.total_s;
      canvas.setAttribute("aria-label", `${search.agent} after ${seconds2(seconds)} s: ${statusText}`);
      const words = data.terms
        .filter(({ field, optional }) => !optional || search.costs[field] > 0)
        .map((term) => make("span", {}, make("i", { style: `background: ${termColor(term)}` }), `${term.name.replace("_", " ")} `, make("b", {}, seconds2(parts[term.field]))));
      if (over && search.agrees !== null) {
        words.push(make("span", { class: search.agrees ? "check" : "check bad", title: "Whether the simulation reproduced the total time in episodes.csv" }, search.agrees ? "✓ as in episodes.csv" : `episodes.csv: ${seconds2(search.counted_s)} s`));
      }
      split.replaceChildren(...words);
    }
  }
}

/** The legend of the lot's marks. */
function lotLegend() {
  const scale = make("span", { class: "scale", style: "background: linear-gradient(90deg, var(--belief))" });
  const pale = make("span", { class: "scale", style: "background: linear-gradient(90deg, var(--belief)); opacity: 0.42" });
  const car = markSvg(26, makeSvg("rect", { x: 2, y: 3, width: 22, height: 10, rx: 3, style: "fill: var(--parked); stroke: var(--faint); stroke-width: 0.8" }), makeSvg("rect", { x: 15, y: 5, width: 3, height: 6, style: "fill: var(--glass)" }));
  const mine = markSvg(26, makeSvg("rect", { x: 2, y: 3, width: 22, height: 10, rx: 3, style: "fill: var(--car); stroke: #1c2126; stroke-width: 1.4" }));
  const plan = markSvg(34, makeSvg("path", { d: "M1 8H33", style: "stroke: var(--ink); stroke-width: 1.6" }), makeSvg("path", { d: "M21 8l-8-4.5 2.5 4.5-2.5 4.5z", style: "fill: var(--ink)" }));
  const walk = markSvg(34, makeSvg("path", { d: "M1 8H33", style: "stroke: var(--goal); stroke-width: 2; stroke-dasharray: 5 4" }));
  const goal = markSvg(18, makeSvg("circle", { cx: 9, cy: 8, r: 7, style: "fill: var(--goal)" }), makeSvg("circle", { cx: 9, cy: 8, r: 2.6, style: "fill: var(--halo)" }));
  return make(
    "div", { class: "legend lot" },
    keyed(make("span", {}, "free ", scale), "taken: belief, slots observed"), keyed(pale, "forecast, slots not observed yet"),
    keyed(car, "parked car"), keyed(mine, "searching car"), keyed(plan, "its plan"), keyed(walk, "walk"), keyed(goal, "goal"),
  );
}
