// Survey drives: camera frame with detections, laser scan, occupancy grid and slots, synchronised.

const SIDE = "#ff7f50";
const END = "#56b4e9";
const NOWHERE = "#c8c8c8";
const WRONG = "#e0218a";

class DriveReplay {
  constructor(root, data) {
    this.data = data;
    this.choice = make("select", {}, ...data.drives.map((drive, i) => make("option", { value: i }, `${drive.scenario} · ${moment(drive.time_s, drive.day)} · ${drive.weather}`)));
    this.choice.addEventListener("change", () => this.open(Number(this.choice.value)));
    const panel = (title, aside, ...children) => make("article", { class: "card panel" }, make("header", {}, make("h3", {}, title), aside), ...children);
    this.picture = make("canvas", { role: "img" });
    this.around = make("canvas", { role: "img" });
    this.grid = make("canvas", { role: "img" });
    this.slots = make("canvas", { role: "img" });
    this.facts = make("div", { class: "facts" });
    this.when = make("span", { class: "status" });
    this.player = new Player(root, {
      name: "drive", speeds: [1, 2, 5, 10, 20, 50], speed: 10,
      show: (seconds) => this.show(seconds),
      describe: (seconds) => `${seconds2(seconds)} of ${seconds2(this.player.duration)} s`,
    });
    const strip = make("div", { class: "strips" }, this.player.time);
    this.player.time.style.gridColumn = "1 / -1";
    root.append(
      make("p", { class: "quiet" }, "The drive is simulated again with the same sensors and perception pipeline: camera frames with detections, laser scans with ranged cars, and the occupancy grid and slots from all captures so far."),
      make("div", { class: "controls" }, make("label", {}, "Drive ", this.choice)),
      make("div", { class: "drive" },
        make("div", {}, panel("Camera", this.when, this.picture), panel("Around the car", null, this.around)),
        make("div", {}, panel("Occupancy grid", null, this.grid), panel("Slots", null, this.slots, this.facts))),
      make("div", { class: "card transport" }, strip, this.player.keys),
      driveLegend(),
    );
    this.open(0);
    onNewWidth(root, () => {
      this.layOut();
      this.draw();
    });
  }

  open(number) {
    this.record = this.data.drives[number];
    this.lot = this.data.lots[this.record.lot];
    this.times = this.record.frames.map((frame) => frame.t);
    this.pictures = new Map();
    this.applied = 0;
    this.number = -1;
    const [around, grid, slots] = [this.around, this.grid, this.slots].map((canvas) => new LotView(canvas, this.lot));
    around.follow = true;
    this.views = [around, grid, slots];
    this.layOut();
    this.player.load(this.times[this.times.length - 1], this.times);
    // At the start the sensors see little: before it is played, the page shows the frame with the most cars from a third of the drive on.
    const { frames } = this.record;
    const third = Math.floor(frames.length / 3);
    const fullest = frames.reduce((best, frame, i) => (i > third && frame.cars.length > frames[best].cars.length ? i : best), third);
    this.player.goTo(this.times[fullest]);
  }

  layOut() {
    for (const view of this.views) view.resize();
    const width = this.picture.clientWidth;
    const ratio = Math.min(window.devicePixelRatio || 1, 3);
    this.picture.style.height = `${Math.round(width * 0.75)}px`;
    this.picture.width = Math.round(width * ratio);
    this.picture.height = Math.round(width * 0.75 * ratio);
  }

  /** Return an image of a frame, decoded once; redraw when it is loaded. */
  image(number, name) {
    const key = `${name}${number}`;
    if (!this.pictures.has(key)) {
      const image = new Image();
      image.onload = () => { if (this.number === number) this.draw(); };
      image.src = this.record.frames[number][name];
      this.pictures.set(key, image);
    }
    const image = this.pictures.get(key);
    return image.complete && image.naturalWidth ? image : null;
  }

  show(seconds) {
    const number = Math.max(0, lastUpTo(this.times, seconds + 1e-6));
    if (number === this.number) return;
    const { frames } = this.record;
    if (number + 1 < this.applied || this.applied === 0) {
      this.applied = 0;
      this.belief = new Int16Array(this.lot.slots.length).fill(-1);
      this.taken = new Uint8Array(this.lot.slots.length);
    }
    for (; this.applied <= number; this.applied += 1) {
      const { belief, truth } = frames[this.applied];
      for (let i = 0; i < belief.length; i += 2) this.belief[belief[i]] = belief[i + 1];
      for (let i = 0; i < truth.length; i += 2) this.taken[truth[i]] = truth[i + 1];
    }
    this.number = number;
    for (const next of [number + 1, number + 2]) if (next < frames.length) for (const name of ["picture", "map"]) this.image(next, name);
    this.draw();
  }

  draw() {
    if (this.number < 0) return;
    const frame = this.record.frames[this.number];
    this.drawPicture(frame);
    const [around, grid, slots] = this.views;
    this.drawMap(around, frame, () => { this.drawSlots(around, false); this.drawScan(around, frame); });
    this.drawMap(grid, frame, () => { this.drawGrid(grid); });
    this.drawMap(slots, frame, () => { this.drawSlots(slots, true); });
    let [judged, right] = [0, 0];
    this.belief.forEach((value, i) => {
      if (value < 0) return;
      judged += 1;
      right += (value > 127) === Boolean(this.taken[i]);
    });
    const cars = frame.boxes.filter((box) => box[6]).length;
    const fact = (name, value) => make("span", {}, make("b", {}, value), name);
    this.facts.replaceChildren(
      fact(cars === 1 ? "car in this frame" : "cars in this frame", String(cars)),
      fact(`of ${this.belief.length} slots classified`, String(judged)),
      fact("of those correct", judged ? `${((100 * right) / judged).toFixed(1)} %` : "–"),
    );
    this.when.textContent = `capture ${this.number + 1} of ${this.record.frames.length} shown; ${this.record.weather}`;
  }

  drawPicture(frame) {
    const context = this.picture.getContext("2d");
    const { width, height } = this.picture;
    const image = this.image(this.number, "picture");
    if (!image) return;
    context.drawImage(image, 0, 0, width, height);
    const ratio = Math.min(window.devicePixelRatio || 1, 3);
    context.font = `600 ${12 * ratio}px system-ui, sans-serif`;
    for (const [left, top, right, bottom, p, end, placed] of frame.boxes) {
      context.strokeStyle = placed ? (end ? END : SIDE) : NOWHERE;
      context.lineWidth = (placed ? 2.2 : 1) * ratio;
      context.strokeRect(left * width, top * height, (right - left) * width, (bottom - top) * height);
      if (!placed) continue;
      const text = p.toFixed(2);
      const [x, y] = [Math.max(left, 0) * width, Math.max(top, 0) * height];
      context.fillStyle = context.strokeStyle;
      context.fillRect(x, y, context.measureText(text).width + 8 * ratio, 17 * ratio);
      context.fillStyle = "#14171a";
      context.fillText(text, x + 4 * ratio, y + 13 * ratio);
    }
    this.picture.setAttribute("aria-label", `Camera, with ${frame.boxes.length} detections`);
  }

  /** Draw a lot with the path so far and the car; `more` draws what lies between. */
  drawMap(view, frame, more) {
    const [x, y, yaw] = frame.pose;
    view.begin([x, y]);
    view.drawSlots(() => -1, () => true, () => false);
    more();
    view.drawLine(this.record.frames.slice(0, this.number + 1).map((other) => other.pose), palette.car, 2);
    view.drawCar(x, y, yaw);
    view.drawScale();
    view.canvas.setAttribute("aria-label", `The lot after ${seconds2(frame.t)} s`);
  }

  /** Draw the slot filter's state, pale unless `strong`, the cars that stand there, and a bright edge around slots that are wrong now. */
  drawSlots(view, strong) {
    view.drawSlots((i) => this.belief[i], () => strong, (i) => this.taken[i]);
    const wrong = (i) => this.belief[i] >= 0 && (this.belief[i] > 127) !== Boolean(this.taken[i]);
    view.slots.forEach((slot, i) => {
      if (wrong(i)) view.outline(slot, palette.halo, 5.5);
      if (wrong(i)) view.outline(slot, WRONG, 3.5);
    });
  }

  drawGrid(view) {
    const image = this.image(this.number, "map");
    if (!image) return;
    const { context } = view;
    const { grid } = this.record;
    context.save();
    context.imageSmoothingEnabled = false;
    if (document.documentElement.dataset.theme === "dark") context.filter = "brightness(1.9)";
    context.translate(grid.x, grid.y + grid.height);
    context.scale(1, -1);
    context.drawImage(image, 0, 0, grid.width, grid.height);
    context.restore();
  }

  /** Draw the ends of the beams, and the cars fitted to them. */
  drawScan(view, frame) {
    const { context } = view;
    const [x, y] = frame.pose;
    context.fillStyle = palette.ink;
    const size = Math.max(0.16, view.px(3));
    for (let i = 0; i < frame.scan.length; i += 2) context.fillRect(x + frame.scan[i] / 10 - size / 2, y + frame.scan[i + 1] / 10 - size / 2, size, size);
    for (const [cx, cy, yaw, length, width] of frame.cars) {
      view.outline({ x: cx, y: cy, yaw, length, width }, palette.halo, 4.5);
      view.outline({ x: cx, y: cy, yaw, length, width }, palette.ink, 2.5);
    }
  }
}

function driveLegend() {
  const key = (color, text, hollow) => keyed(make("span", { class: "swatch", style: hollow ? `border: 2px solid ${color}` : `background: ${color}` }), text);
  const scale = make("span", { class: "scale", style: "background: linear-gradient(90deg, var(--belief))" });
  const grid = make("span", { class: "scale grid", style: "background: linear-gradient(90deg, #96bed755, #7030aa)" });
  return make(
    "div", { class: "legend lot" },
    key(SIDE, "a car's side", true), key(END, "front or rear", true), key(NOWHERE, "not ranged", true),
    keyed(make("span", {}, "free ", scale), "taken, slots"), keyed(make("span", {}, "free ", grid), "car, grid"),
    key("var(--parked)", "parked car"), key("var(--car)", "the car and its path"), key("var(--ink)", "scan"), key("var(--ink)", "car fitted to its beams", true),
    key(WRONG, "slot classified wrong", true),
  );
}
