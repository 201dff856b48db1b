// A town's day on a map: blocks coloured by how full they are, lanes by how much is cruised in them, hour by hour.

/** What colours the blocks: how it is read from a map, its unit, and how it is written. */
const MEASURES = {
  occupancy: { label: "spaces taken", write: (value) => `${written(100 * value, 0)} %`, most: 1 },
  refused: { label: "cars refused an hour", write: (value) => written(value, value < 10 ? 1 : 0) },
  search_s: { label: "search time of those who park", write: (value) => `${written(value / 60, 1)} min` },
  paid: { label: "revenue an hour", write: (value) => written(value, value < 100 ? 2 : 0) },
};
/** How far from a block, px, a click still chooses it; and the movement that makes a press a drag. */
const [NEAR, DRAGGED] = [14, 5];
/** px/m: the greatest scale, and the least to show a block that was named. */
const [CLOSEST, NAMED] = [12, 1.2];
const HOUR = 3600;

/** A map that is moved and zoomed: by the wheel, by one finger or two, by keys and buttons. */
class TownView extends LotView {
  constructor(canvas, town) {
    super(canvas, { bounds: town.bounds, slots: [], ground: town.ground });
    this.town = town;
    this.shown = null;
    const path = (parts, close) => {
      const made = new Path2D();
      for (const points of parts) {
        for (let i = 0; i < points.length; i += 2) made[i ? "lineTo" : "moveTo"](points[i], points[i + 1]);
        if (close) made.closePath();
      }
      return made;
    };
    this.blocks = town.blocks.map((block) => path(block.areas.flat(), true));
    this.lanes = town.lanes.map((points) => path([points], false));
    this.lengths = town.lanes.map((points) => {
      let metres = 0;
      for (let i = 2; i < points.length; i += 2) metres += Math.hypot(points[i] - points[i - 2], points[i + 1] - points[i - 1]);
      return metres;
    });
  }

  viewpoint() {
    const at = this.shown ?? this.whole;
    if (at !== this.at) this.ground = null;
    return at;
  }

  /** Show a place at a scale; at the least scale the whole town. */
  show(scale, x, y) {
    const kept = Math.min(scale, CLOSEST);
    this.shown = kept <= this.whole.scale * 1.001 ? null : { scale: kept, x, y };
    // A finger moves what is larger than the screen; else it scrolls the page.
    this.canvas.style.touchAction = this.shown ? "none" : "pan-x pan-y";
  }

  /** Zoom by a factor around a point of the canvas, which stays where it is. */
  zoom(factor, at = [this.width / 2, this.height / 2]) {
    const place = this.toPlace(at);
    const scale = Math.min(Math.max(this.at.scale * factor, this.whole.scale), CLOSEST);
    this.show(scale, place[0] - (at[0] - this.width / 2) / scale, place[1] + (at[1] - this.height / 2) / scale);
  }

  /** Move by pixels. */
  move(right, down) {
    if (this.shown) this.show(this.at.scale, this.at.x - this.px(right), this.at.y + this.px(down));
  }

  /** Return the number of the block at a point of the canvas, or null. */
  blockAt(point) {
    const [x, y] = this.toPlace(point);
    let [best, found] = [this.px(NEAR), null];
    this.town.blocks.forEach((block, number) => {
      const metres = Math.min(...block.areas.map((rings) => distanceTo(rings, x, y)));
      if (metres < best) [best, found] = [metres, number];
    });
    return found;
  }

  /** Paint blocks and lanes: a block's colour, or null; a lane's cruising cars an hour, of at most so many; the chosen block. */
  paint(colorOf, cruised, most, chosen) {
    const context = this.begin();
    context.lineJoin = "round";
    context.lineCap = "round";
    const least = this.px(2.2);
    this.blocks.forEach((path, number) => {
      const color = colorOf(number);
      context.fillStyle = context.strokeStyle = color ?? palette.wall;
      context.globalAlpha = color === null ? 0.25 : 1;
      context.lineWidth = least;
      context.fill(path, "evenodd");
      context.stroke(path);
    });
    context.strokeStyle = palette.cruise;
    this.lanes.forEach((path, number) => {
      const share = Math.min(Math.sqrt(cruised(number) / most), 1);
      if (share < 0.12) return;
      context.globalAlpha = 0.2 + 0.6 * share;
      context.lineWidth = Math.max(this.px(0.5 + 2.5 * share), 3.2 * share);
      context.stroke(path);
    });
    context.globalAlpha = 1;
    if (chosen !== null) {
      for (const [color, pixels] of [[palette.halo, 6], [palette.ink, 3]]) {
        context.strokeStyle = color;
        context.lineWidth = this.px(pixels) + least;
        context.stroke(this.blocks[chosen]);
      }
      context.fillStyle = colorOf(chosen) ?? palette.wall;
      context.fill(this.blocks[chosen], "evenodd");
    }
    this.drawSigns();
    this.drawScale();
  }

  /** Write P on car parks and garages that are large enough in the picture. */
  drawSigns() {
    const { context } = this;
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillStyle = palette.halo;
    for (const { type, at, slots } of this.town.blocks) {
      const side = Math.sqrt(6 * slots) * this.at.scale;
      if (type === "kerb" || type === "zone" || side < 14) continue;
      const [x, y] = this.toPixels(at);
      if (x < 0 || y < 0 || x > this.width || y > this.height) continue;
      context.font = `700 ${Math.min(Math.round(0.62 * side), 30)}px system-ui, sans-serif`;
      context.fillText("P", x, y + 1);
    }
    context.textAlign = "start";
    context.textBaseline = "alphabetic";
    this.toMetres(context);
  }
}

/** Metres from a place to a polygon with holes, 0 inside. */
function distanceTo(rings, x, y) {
  let [inside, least] = [false, Infinity];
  for (const ring of rings) {
    for (let i = 0, before = ring.length - 2; i < ring.length; before = i, i += 2) {
      const [ax, ay, bx, by] = [ring[before], ring[before + 1], ring[i], ring[i + 1]];
      if ((ay > y) !== (by > y) && x < ax + ((y - ay) / (by - ay)) * (bx - ax)) inside = !inside;
      const [dx, dy] = [bx - ax, by - ay];
      const along = Math.min(Math.max(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1), 0), 1);
      least = Math.min(least, Math.hypot(x - ax - along * dx, y - ay - along * dy));
    }
  }
  return inside ? 0 : least;
}

/** The hours of a map: what happens in a block, or in all of them, and in a lane. */
class TownDay {
  constructor(recorded, town, lengths) {
    this.recorded = recorded;
    this.town = town;
    this.hours = recorded.hours;
    this.begin = HOUR * this.hours[0];
    this.duration = HOUR * this.hours.length;
    this.cruised = new Map(recorded.lanes.map(([lane, ...metres]) => [lane, metres]));
    this.every = this.sums();
    // Metres over the length of a lane are cars that drive through it.
    const cars = recorded.lanes.flatMap(([lane, ...metres]) => metres.map((its) => its / lengths[lane])).sort((a, b) => a - b);
    this.busy = Math.max(5, Math.ceil((cars[Math.floor(0.97 * cars.length)] ?? 0) / 5) * 5);
  }

  /** Return the course of a measure in a block; of all blocks if it is null. */
  course(measure, block) {
    return block === null ? this.every[measure] : this.recorded.blocks[measure][block];
  }

  /** Sums over all blocks; shares and times are means, weighted by spaces and by cars. */
  sums() {
    const { blocks } = this.recorded;
    const weighted = (values, weight) => this.hours.map((_, hour) => {
      let [sum, total] = [0, 0];
      values.forEach((its, block) => {
        if (its[hour] === null) return;
        sum += weight(block, hour) * its[hour];
        total += weight(block, hour);
      });
      return total ? sum / total : null;
    });
    const sum = (values) => this.hours.map((_, hour) => values.reduce((total, its) => total + its[hour], 0));
    const cars = (block, hour) => blocks.arrivals[block][hour];
    return {
      occupancy: weighted(blocks.occupancy, (block) => this.town.blocks[block].slots),
      search_s: weighted(blocks.search_s, cars),
      walk_s: weighted(blocks.walk_s, cars),
      ...Object.fromEntries(["arrivals", "refused", "paid"].map((name) => [name, sum(blocks[name])])),
    };
  }

  /** Return a course at a time: hours are means, at their middle; between them it is linear. */
  at(course, seconds) {
    const place = Math.min(Math.max(seconds / HOUR - 0.5, 0), course.length - 1);
    const [before, share] = [Math.floor(place), place % 1];
    const [from, to] = [course[before], course[Math.min(before + 1, course.length - 1)]];
    if (from === null || to === null) return share < 0.5 ? from : to;
    return from + share * (to - from);
  }

  /** Return the hour that a time is in. */
  hourAt(seconds) {
    return Math.min(Math.floor(seconds / HOUR), this.hours.length - 1);
  }
}

const counted = (number, what) => `${number} ${what}${number === 1 ? "" : "s"}`;
const clockOf = (hour) => `${String(hour % 24).padStart(2, "0")}:00`;

/** The map with its slider, and what is told of the chosen block. */
class TownMap {
  constructor(root, data) {
    this.data = data;
    this.chosen = null;
    this.measure = "occupancy";
    const settings = data.maps.map((map) => this.nameOf(map));
    this.settingChoice = make("select", { id: "map-setting" }, ...settings.map((name, i) => make("option", { value: i }, name)));
    this.settingChoice.addEventListener("change", () => this.open(Number(this.settingChoice.value), this.player.seconds));
    this.measureChoice = make("select", { id: "map-measure" });
    this.measureChoice.addEventListener("change", () => { this.measure = this.measureChoice.value; this.scale = this.most(); this.draw(); });
    this.blockChoice = make("select", { id: "map-block" });
    this.blockChoice.addEventListener("change", () => this.choose(this.blockChoice.value === "" ? null : Number(this.blockChoice.value), true));
    const labelled = (text, choice) => make("label", {}, `${text} `, choice);
    this.canvas = make("canvas", { class: "town", tabindex: 0, role: "img" });
    const key = (text, label, press) => make("button", { type: "button", "aria-label": label, title: label, onclick: () => { press(); this.draw(); } }, text);
    const zooms = make("div", { class: "zooms" }, key("+", "Zoom in (+)", () => this.view.zoom(1.6)), key("−", "Zoom out (−)", () => this.view.zoom(1 / 1.6)), key("⤢", "Whole town (0)", () => this.view.show(0)));
    this.counts = make("div", { class: "counts" });
    this.about = make("aside", { class: "card about", "aria-live": "polite" });
    this.player = new Player(root, {
      name: "day", speeds: [600, 1800, 3600], speed: 1800,
      show: (seconds) => this.show(seconds),
      describe: (seconds) => moment((this.day?.begin ?? 0) + seconds, "").slice(4),
    });
    this.strip = make("div", { class: "strips" });
    this.legend = make("div", { class: "legend lot" });
    root.append(
      make("div", { class: "controls" }, settings.length > 1 ? labelled("Setting", this.settingChoice) : null, labelled("Colour", this.measureChoice), labelled("Block", this.blockChoice)),
      make("div", { class: "town-parts" },
        make("article", { class: "card panel" }, make("div", { class: "map" }, this.canvas, zooms), this.counts), this.about,
        make("div", { class: "card transport" }, this.strip, this.player.keys)),
      this.legend,
    );
    this.listen();
    this.open(0, null);
    onNewWidth(root, () => this.redraw());
  }

  /** Name of a setting among the others. */
  nameOf(map) {
    const differ = (name) => new Set(this.data.maps.map((other) => other[name])).size > 1;
    const rate = map.arrivals_per_hour;
    const words = [["scenario", map.scenario], ["agents", shortName(map.agents)], ["arrivals_per_hour", typeof rate === "string" ? `demand ${rate}` : `${rate} cars an hour`], ["knows", KNOWS[map.knows]], ["share", `${written(100 * map.share, 0)} % members`]];
    const shown = words.filter(([name]) => differ(name)).map(([, text]) => text);
    return shown.join(", ") || map.scenario;
  }

  open(number, seconds) {
    const recorded = this.data.maps[number];
    const town = this.data.towns[recorded.town];
    if (town !== this.town) {
      this.town = town;
      this.chosen = null;
      this.view = new TownView(this.canvas, town);
      this.view.show(0);
      const named = town.blocks.map((block, i) => [block.name, i]).sort(([a], [b]) => a.localeCompare(b, "en", { numeric: true }));
      this.blockChoice.replaceChildren(make("option", { value: "" }, `all ${town.blocks.length}`), ...named.map(([name, i]) => make("option", { value: i }, name)));
    }
    this.day = new TownDay(recorded, town, this.view.lengths);
    const known = Object.keys(MEASURES).filter((name) => name === "occupancy" || this.day.recorded.blocks[name].some((its) => its.some((value) => value > 0)));
    if (!known.includes(this.measure)) this.measure = "occupancy";
    this.measureChoice.replaceChildren(...known.map((name) => make("option", { value: name, selected: name === this.measure }, MEASURES[name].label)));
    this.scale = this.most();
    this.layStrip();
    this.player.load(this.day.duration, this.day.hours.map((_, i) => HOUR * (i + 0.5)));
    const { occupancy } = this.day.every;
    const fullest = occupancy.indexOf(Math.max(...occupancy));
    this.player.goTo(seconds ?? HOUR * (fullest + 0.5));
  }

  /** The day of the whole town above the slider: searching cars as an area, spaces taken as a line. */
  layStrip() {
    const { searching } = this.day.recorded.states;
    const { occupancy } = this.day.every;
    const n = this.day.hours.length;
    const most = Math.max(...searching, 1);
    const x = (hour) => (100 * (hour + 0.5)) / n;
    const points = (values) => values.map((value, hour) => `${x(hour).toFixed(2)},${(98 - 92 * value).toFixed(2)}`);
    // Cars that search are counted when an hour ends.
    const ends = ["0,98", ...searching.map((value, hour) => `${((100 * (hour + 1)) / n).toFixed(2)},${(98 - (92 * value) / most).toFixed(2)}`), "100,98"];
    const svg = makeSvg("svg", { viewBox: "0 0 100 100", preserveAspectRatio: "none", role: "img", "aria-label": `Spaces taken in the town, at most ${written(100 * Math.max(...occupancy), 0)} %; searching cars, at most ${written(most, 0)} at the end of an hour` },
      makeSvg("line", { class: "full", x1: 0, x2: 100, y1: 6, y2: 6 }),
      makeSvg("polygon", { class: "searching", points: ends.join(" ") }),
      makeSvg("polyline", { class: "taken", points: points(occupancy).join(" ") }));
    this.playhead = make("div", { class: "playhead" });
    this.courseOf = make("div", { class: "course" }, svg);
    this.strip.replaceChildren(make("span", { class: "who" }, "The town", make("small", {}, `at most ${written(most, 0)} searching`)), this.courseOf, make("span", { class: "total" }, ""), this.player.time, this.playhead);
  }

  /** The scale of the measure: the greatest value in any block and hour, but for outliers. */
  most() {
    const { most } = MEASURES[this.measure];
    if (most) return most;
    const values = this.day.recorded.blocks[this.measure].flat().filter((value) => value > 0).sort((a, b) => a - b);
    return values[Math.floor(0.98 * (values.length - 1))] ?? 1;
  }

  colorOf(value) {
    if (value === null) return null;
    const share = Math.min(value / this.scale, 1);
    return palette.taken[Math.round(this.measure === "occupancy" ? 255 * share : 127.5 * (1 + share))];
  }

  show(seconds) {
    if (!this.day) return;
    this.draw();
    const [{ offsetLeft, offsetTop, offsetWidth, offsetHeight }] = [this.courseOf];
    this.playhead.style.cssText = `left: ${offsetLeft + (offsetWidth * seconds) / this.day.duration}px; top: ${offsetTop - 3}px; height: ${offsetHeight + 6}px`;
  }

  redraw() {
    this.view.resize();
    this.view.show(0);
    this.show(this.player.seconds);
  }

  draw() {
    const { day, view, player: { seconds } } = this;
    const value = (block) => day.at(day.course(this.measure, block), seconds);
    const cruised = (lane) => (day.cruised.has(lane) ? day.at(day.cruised.get(lane), seconds) / view.lengths[lane] : 0);
    view.paint((block) => this.colorOf(value(block)), cruised, day.busy, this.chosen);
    for (const goal of this.town.goals) view.drawDot(goal[0], goal[1], this.town.goals.length > 1 ? 3 : 6, palette.goal);
    if (this.hovered !== undefined && this.hovered !== null) {
      const now = value(this.hovered);
      view.drawName({ x: this.town.blocks[this.hovered].at[0], y: this.town.blocks[this.hovered].at[1] }, `${this.town.blocks[this.hovered].name} · ${now === null ? "–" : MEASURES[this.measure].write(now)}`);
    }
    this.tellTown(seconds);
    this.tellBlock(seconds);
    this.layLegend();
  }

  /** Where all cars are at the end of the hour. */
  tellTown(seconds) {
    const { states } = this.day.recorded;
    const hour = this.day.hourAt(seconds);
    const [, clock] = moment(this.day.begin + seconds, "").split(" ");
    const taken = this.day.at(this.day.every.occupancy, seconds);
    const away = states.balked[hour] + states.gave_up[hour] + states.truncated[hour];
    const words = [["still to come", states.due[hour]], ["searching", states.searching[hour]], ["parked", states.parked[hour]], ["have left", states.left[hour]], ["went elsewhere", away]];
    this.counts.replaceChildren(
      make("span", { class: "hour" }, make("b", {}, clock), ` ${written(100 * taken, 0)} % taken; by ${clockOf(this.day.hours[hour] + 1)}:`),
      ...words.map(([text, count]) => make("span", {}, make("b", {}, written(count, 0)), ` ${text}`)));
    this.canvas.setAttribute("aria-label", `Map at ${clock}: ${written(100 * taken, 0)} % of the spaces taken, ${written(states.searching[hour], 0)} cars searching. Arrow keys move, plus and minus zoom, 0 shows all.`);
  }

  /** The day of the chosen block, or of all. */
  tellBlock(seconds) {
    const { day, chosen, town } = this;
    const hour = day.hourAt(seconds);
    if (this.told?.day !== day || this.told.chosen !== chosen) {
      const block = chosen === null ? null : town.blocks[chosen];
      const spaces = block ? block.slots : town.blocks.reduce((sum, { slots }) => sum + slots, 0);
      const kind = block ? [block.type, block.zone && block.zone !== block.name ? `zone ${block.zone}` : null] : [counted(town.blocks.length, "block")];
      const words = [...kind, counted(spaces, "space"), block?.rules].filter(Boolean).join(" · ");
      const rows = day.hours.map((from, i) => this.hourRow(from, i));
      const heads = ["hour", "taken", "cars", "refused", "search", "walk", this.pays() ? "paid" : null].filter(Boolean);
      this.about.replaceChildren(
        make("h3", {}, block ? block.name : town.name), make("p", { class: "quiet" }, words), this.blockChart(),
        make("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "By hour" }, make("table", {}, make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", {}, text)))), make("tbody", {}, ...rows))),
        make("p", { class: "quiet small" }, `${day.recorded.days === 1 ? "One day" : `Means of ${day.recorded.days} days`}. Search and walk, in minutes, of the cars that park in the hour.`),
      );
      this.told = { day, chosen };
    }
    [...this.about.querySelectorAll("tbody tr")].forEach((row, i) => row.classList.toggle("now", i === hour));
    this.about.querySelector(".playing")?.setAttribute("x", String((300 * seconds) / day.duration - 0.5));
  }

  pays() {
    return this.day.every.paid.some((value) => value > 0);
  }

  hourRow(from, i) {
    const value = (measure) => this.day.course(measure, this.chosen)[i];
    const minutes = (seconds) => (seconds === null ? "–" : written(seconds / 60, 1));
    const [taken, cars] = [value("occupancy"), value("arrivals")];
    const count = (number) => written(number, number > 0 && number < 9.95 && !Number.isInteger(number) ? 1 : 0);
    const cells = [clockOf(from), taken === null ? "–" : `${written(100 * taken, 0)} %`, count(cars), count(value("refused")), minutes(value("search_s")), minutes(value("walk_s")), this.pays() ? written(value("paid"), value("paid") < 100 ? 2 : 0) : null];
    return make("tr", {}, ...cells.filter((text) => text !== null).map((text) => make("td", {}, text)));
  }

  /** Spaces taken as a line, and cars that park, and are refused, as bars. */
  blockChart() {
    const [width, height] = [300, 92];
    const { day, chosen } = this;
    const n = day.hours.length;
    const [cars, refused, taken] = ["arrivals", "refused", "occupancy"].map((name) => day.course(name, chosen));
    const most = Math.max(...cars.map((value, i) => value + refused[i]), 1e-9);
    const step = width / n;
    const svg = makeSvg("svg", { class: "block-chart", viewBox: `0 0 ${width} ${height + 14}`, role: "img", "aria-label": `Taken by hour: ${taken.map((value, i) => `${clockOf(day.hours[i])} ${value === null ? "unknown" : `${written(100 * value, 0)} %`}`).join(", ")}` });
    const bar = (i, from, value, color) => {
      const [top, tall] = [height - (0.55 * height * (from + value)) / most, (0.55 * height * value) / most];
      svg.append(makeSvg("rect", { x: i * step + 0.18 * step, y: top, width: 0.64 * step, height: Math.max(tall, 0), style: `fill: var(${color})` }));
    };
    svg.append(makeSvg("line", { class: "axis", x1: 0, x2: width, y1: height, y2: height }), makeSvg("line", { class: "full", x1: 0, x2: width, y1: 3, y2: 3 }));
    cars.forEach((value, i) => { bar(i, 0, value, "--bar"); bar(i, value, refused[i], "--failed"); });
    const points = taken.flatMap((value, i) => (value === null ? [] : [`${(i + 0.5) * step},${height - (height - 3) * value}`]));
    svg.append(makeSvg("polyline", { class: "taken", points: points.join(" ") }), makeSvg("rect", { class: "playing", y: 0, width: 1, height }));
    const every = n > 8 ? 3 : 1;
    day.hours.forEach((from, i) => {
      if (i % every) return;
      const label = makeSvg("text", { x: i * step, y: height + 12 });
      label.textContent = clockOf(from);
      svg.append(label);
    });
    return svg;
  }

  layLegend() {
    const key = `${this.measure} ${this.scale} ${this.day.busy} ${document.documentElement.dataset.theme}`;
    if (this.legend.dataset.key === key) return;
    this.legend.dataset.key = key;
    const { write, label } = MEASURES[this.measure];
    const colors = Array.from({ length: 9 }, (_, i) => this.colorOf((this.scale * i) / 8));
    const ramp = make("span", { class: "scale", style: `background: linear-gradient(90deg, ${colors.join(", ")})` });
    const cruise = make("span", { class: "scale cruise" });
    const line = markSvg(24, makeSvg("path", { d: "M1 8H23", style: "stroke: var(--ink); stroke-width: 1.6" }));
    const box = (color) => markSvg(16, makeSvg("rect", { x: 2, y: 3, width: 12, height: 10, style: `fill: var(${color})` }));
    const goal = markSvg(16, makeSvg("circle", { cx: 8, cy: 8, r: 4, style: "fill: var(--goal)" }));
    this.legend.replaceChildren(
      make("span", { class: "key" }, write(0), ramp, `${write(this.scale)} ${label}`), make("span", { class: "key" }, "0", cruise, `${this.day.busy} cruising cars an hour`),
      keyed(goal, this.town.goals.length > 1 ? "goals" : "goal"), keyed(line, "spaces taken"), keyed(box("--bar"), "cars that park"), keyed(box("--failed"), "refused"), keyed(box("--car"), "searching"));
  }

  /** Choose a block, or all with null; if it was named, it is brought into view. */
  choose(block, named = false) {
    this.chosen = block;
    this.blockChoice.value = block === null ? "" : String(block);
    if (named && block !== null) this.view.show(Math.max(this.view.at.scale, NAMED), ...this.town.blocks[block].at);
    this.draw();
  }

  listen() {
    const { canvas } = this;
    const pointers = new Map();
    let moved = 0;
    const place = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (!pointers.size) moved = 0;
      pointers.set(event.pointerId, place(event));
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const now = place(event);
      const before = pointers.get(event.pointerId);
      if (!before) {
        const hovered = event.pointerType === "mouse" ? this.view.blockAt(now) : null;
        if (hovered === this.hovered) return;
        this.hovered = hovered;
        canvas.style.cursor = hovered === null ? (this.view.shown ? "grab" : "default") : "pointer";
        this.draw();
        return;
      }
      const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      pointers.set(event.pointerId, now);
      moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
      if (others.length === 1) {
        const [other] = others;
        const apart = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]);
        this.view.zoom(apart(now) / Math.max(apart(before), 1), [(now[0] + other[0]) / 2, (now[1] + other[1]) / 2]);
      } else if (!others.length && moved > DRAGGED) this.view.move(now[0] - before[0], now[1] - before[1]);
      this.draw();
    });
    const end = (event) => {
      const pressed = pointers.delete(event.pointerId);
      if (pressed && event.type === "pointerup" && moved <= DRAGGED && !pointers.size) this.choose(this.view.blockAt(place(event)));
    };
    for (const type of ["pointerup", "pointercancel"]) canvas.addEventListener(type, end);
    canvas.addEventListener("pointerleave", () => { this.hovered = null; this.draw(); });
    canvas.addEventListener("wheel", (event) => {
      // The page scrolls past a map that shows the whole town, unless a key asks for more.
      if (!this.view.shown && !event.ctrlKey && document.activeElement !== canvas) return;
      event.preventDefault();
      this.view.zoom(1.0015 ** -event.deltaY, place(event));
      this.draw();
    }, { passive: false });
    const keys = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key in keys && this.view.shown) this.view.move(...keys[event.key]);
      else if (event.key === "+" || event.key === "=") this.view.zoom(1.6);
      else if (event.key === "-") this.view.zoom(1 / 1.6);
      else if (event.key === "0") this.view.show(0);
      else if (event.key === "Escape") this.choose(null);
      else return;
      event.preventDefault();
      event.stopPropagation();
      this.draw();
    });
  }
}
