// A lot from above on a canvas: the static layer is drawn once for each size, moving things on top of it.

/** Return 256 colours between those of a list in the style sheet. */
function scaleOf(list) {
  const anchors = list.split(",").map((hex) => hex.trim()).map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)));
  return Array.from({ length: 256 }, (_, value) => {
    const at = (value / 255) * (anchors.length - 1);
    const i = Math.min(Math.floor(at), anchors.length - 2);
    return `rgb(${anchors[i].map((a, c) => Math.round(a + (at - i) * (anchors[i + 1][c] - a))).join(" ")})`;
  });
}

/** The colours of the page's theme, from the style sheet. */
const palette = {
  read() {
    const style = getComputedStyle(document.documentElement);
    for (const name of ["ground", "asphalt", "paint", "building", "wall", "parked", "glass", "car", "goal", "halo", "ink", "soft", "view", "card", "entry", "failed", "queue", "member", "other", "resident", "cruise"]) {
      this[name] = style.getPropertyValue(`--${name}`).trim();
    }
    this.belief = scaleOf(style.getPropertyValue("--belief"));
    this.taken = scaleOf(style.getPropertyValue("--taken"));
  },
};

/** Metres shown around the followed car. */
const AROUND = 44;
/** Metres around the lot: its outermost lane, and the car at an entry, are whole. */
const MARGIN = 5;

class LotView {
  /** With fill, the lot fills the canvas, turned with east up if it is then larger; else the height follows from the lot. */
  constructor(canvas, lot, { fill = false } = {}) {
    this.fill = this.turns = fill;
    this.turned = false;
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.lot = lot;
    this.follow = false;
    this.slots = lot.slots.map(([ax, ay, bx, by, cx, cy, dx, dy]) => ({
      x: (ax + cx) / 2, y: (ay + cy) / 2, yaw: Math.atan2(by - ay, bx - ax),
      length: Math.hypot(bx - ax, by - ay), width: Math.hypot(dx - ax, dy - ay),
    }));
    this.resize();
  }

  /** Adopt the canvas's width, and its height if the lot fills it. */
  resize() {
    const [x0, y0, x1, y1] = this.lot.bounds;
    const margin = 2 * MARGIN;
    const size = [x1 - x0 + margin, y1 - y0 + margin];
    const width = this.canvas.clientWidth || 600;
    const most = Math.min(Math.max(420, window.innerHeight * 0.62), 720);
    let height = this.follow ? Math.min(width * 0.72, most) : Math.min((width * size[1]) / size[0], most);
    if (this.fill) {
      height = this.canvas.clientHeight;
      const scale = ([across, up]) => Math.min(width / across, height / up);
      if (this.turns) this.turned = scale(size) < scale([size[1], size[0]]);
    }
    const [across, up] = this.turned ? [size[1], size[0]] : size;
    this.ratio = Math.min(window.devicePixelRatio || 1, 3);
    this.width = width;
    this.height = Math.round(height);
    if (!this.fill) this.canvas.style.height = `${this.height}px`;
    this.canvas.width = Math.round(width * this.ratio);
    this.canvas.height = Math.round(this.height * this.ratio);
    this.whole = { scale: Math.min(width / across, this.height / up), x: (x0 + x1) / 2, y: (y0 + y1) / 2 };
    this.ground = null;
  }

  /** Return what is shown: the whole lot, or in follow mode the surroundings of a place. */
  viewpoint(place) {
    if (!this.follow || !place) return this.whole;
    return { scale: Math.max(this.width / AROUND / 1.25, this.whole.scale), x: place[0], y: place[1] };
  }

  /** Begin a frame; in follow mode, around a place. */
  begin(place) {
    this.at = this.viewpoint(place);
    const context = this.context;
    if (this.follow) {
      this.toMetres(context);
      this.drawGround(context);
    } else {
      if (!this.ground) {
        this.ground = document.createElement("canvas");
        this.ground.width = this.canvas.width;
        this.ground.height = this.canvas.height;
        const still = this.ground.getContext("2d");
        this.toMetres(still);
        this.drawGround(still);
      }
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.drawImage(this.ground, 0, 0);
      this.toMetres(context);
    }
    return context;
  }

  /** Use metres as coordinates, north up, or east if the lot is turned. */
  toMetres(context) {
    const k = this.ratio * this.at.scale;
    const [left, top] = this.toPixels([0, 0]).map((pixels) => this.ratio * pixels);
    if (this.turned) context.setTransform(0, -k, -k, 0, left, top);
    else context.setTransform(k, 0, 0, -k, left, top);
  }

  /** Return where a place is on the canvas. */
  toPixels([x, y]) {
    const [east, north] = [this.at.scale * (x - this.at.x), this.at.scale * (y - this.at.y)];
    return this.turned ? [this.width / 2 - north, this.height / 2 - east] : [this.width / 2 + east, this.height / 2 - north];
  }

  /** Return the place at a point of the canvas. */
  toPlace([left, top]) {
    const [right, up] = [(left - this.width / 2) / this.at.scale, (this.height / 2 - top) / this.at.scale];
    return this.turned ? [this.at.x + up, this.at.y - right] : [this.at.x + right, this.at.y + up];
  }

  /** Convert pixels to metres. */
  px(pixels) {
    return pixels / this.at.scale;
  }

  drawGround(context) {
    const { lot } = this;
    const { x, y, scale } = this.at;
    context.fillStyle = palette.ground;
    const most = Math.max(this.width, this.height) / scale;
    context.fillRect(x - most, y - most, 2 * most, 2 * most);
    context.lineJoin = "round";
    for (const layer of lot.ground) this.paintLayer(context, layer);
    context.globalAlpha = 1;
    context.setLineDash([]);
  }

  /** Paint a layer of the ground: areas with holes, lines, or one shape at several poses. */
  paintLayer(context, layer) {
    const trace = (points) => {
      for (let i = 0; i < points.length; i += 2) context[i ? "lineTo" : "moveTo"](points[i], points[i + 1]);
    };
    context.globalAlpha = layer.opacity;
    context.fillStyle = context.strokeStyle = palette[layer.color];
    context.beginPath();
    if (layer.areas) {
      for (const ring of layer.areas.flat()) {
        trace(ring);
        context.closePath();
      }
      context.fill("evenodd");
    } else if (layer.lines) {
      context.lineWidth = Math.max(layer.width, this.px(layer.px));
      context.setLineDash(layer.dash.map((part) => this.px(part)));
      for (const line of layer.lines) trace(line);
      context.stroke();
      context.setLineDash([]);
    } else {
      const larger = layer.length ? Math.max(1, this.px(layer.px) / layer.length) : 1;
      for (const [x, y, yaw] of layer.marks) {
        context.save();
        context.translate(x, y);
        context.rotate(yaw);
        context.scale(larger, larger);
        trace(layer.shape);
        context.closePath();
        context.restore();
      }
      context.fill();
    }
  }

  arrowHead(context, x, y, yaw, size) {
    context.save();
    context.translate(x, y);
    context.rotate(yaw);
    context.beginPath();
    context.moveTo(0.6 * size, 0);
    context.lineTo(-0.5 * size, 0.5 * size);
    context.lineTo(-0.22 * size, 0);
    context.lineTo(-0.5 * size, -0.5 * size);
    context.closePath();
    context.fill();
    context.restore();
  }

  /**
   * Draw all slots: filled by belief, pale until observed, with a car in taken ones.
   * belief(i) is 0 to 255, or -1 where unknown; seen(i) is a boolean; taken(i), too, or the opacity of the car.
   */
  drawSlots(belief, seen, taken) {
    this.slots.forEach((slot, i) => {
      const value = belief(i);
      this.paintSlot(this.context, slot, value < 0 ? null : palette.belief[value], seen(i) ? 1 : 0.42, () => {
        this.context.globalAlpha = Number(taken(i));
        if (this.context.globalAlpha > 0) this.parkedCar(this.context, Math.min(0.72 * slot.length, 4.2), Math.min(0.52 * slot.width, 1.6));
      });
    });
  }

  /** Paint a slot: filled, unless the colour is null, with its lines; draw() adds what stands in it, along x. */
  paintSlot(context, slot, fill, opacity, draw) {
    const line = Math.max(0.1, this.px(0.75));
    const [l, w] = [slot.length / 2 - line / 2, slot.width / 2 - line / 2];
    context.save();
    context.translate(slot.x, slot.y);
    context.rotate(slot.yaw);
    if (fill) {
      context.globalAlpha = opacity;
      context.fillStyle = fill;
      context.fillRect(-l, -w, 2 * l, 2 * w);
      context.globalAlpha = 1;
    }
    context.strokeStyle = palette.paint;
    context.lineWidth = line;
    context.strokeRect(-l, -w, 2 * l, 2 * w);
    draw();
    context.restore();
  }

  /** Fill the body of a car that heads along x. */
  carBody(context, color, length, width) {
    context.fillStyle = color;
    context.beginPath();
    context.roundRect(-length / 2, -width / 2, length, width, 0.31 * width);
    context.fill();
  }

  parkedCar(context, length, width) {
    this.carBody(context, palette.parked, length, width);
    if (this.at.scale * width < 5) return;
    context.fillStyle = palette.glass;
    context.fillRect(0.1 * length, -0.36 * width, 0.13 * length, 0.72 * width);
    context.fillRect(-0.34 * length, -0.32 * width, 0.09 * length, 0.64 * width);
  }

  /** Draw the searching car. */
  drawCar(x, y, yaw, color = palette.car, pixels = 15) {
    const context = this.context;
    const length = Math.max(4.4, this.px(pixels));
    const width = 0.46 * length;
    context.save();
    context.translate(x, y);
    context.rotate(yaw);
    context.strokeStyle = "#1c2126";
    context.lineWidth = this.px(1.5);
    this.carBody(context, color, length, width);
    context.stroke();
    context.fillStyle = "#1c2126";
    context.fillRect(0.08 * length, -0.34 * width, 0.15 * length, 0.68 * width);
    context.fillRect(-0.34 * length, -0.3 * width, 0.09 * length, 0.6 * width);
    context.restore();
  }

  /** Draw a line with a halo, visible on any background. */
  drawLine(points, color, pixels, dash = []) {
    if (points.length < 2) return;
    const context = this.context;
    context.lineJoin = "round";
    context.lineCap = dash.length ? "butt" : "round";
    for (const [style, width] of [[palette.halo, pixels + 2], [color, pixels]]) {
      context.strokeStyle = style;
      context.globalAlpha = style === palette.halo ? 0.6 : 1;
      context.lineWidth = this.px(width);
      context.setLineDash(style === palette.halo ? [] : dash.map((d) => this.px(d)));
      context.beginPath();
      for (const [x, y] of points) context.lineTo(x, y);
      context.stroke();
    }
    context.globalAlpha = 1;
    context.setLineDash([]);
  }

  /** Draw a plan: a line with arrows along it, and an outline around its last slot. */
  drawPlan(points, endSlot) {
    if (points.length < 2) return;
    this.drawLine(points, palette.ink, 1.6);
    const context = this.context;
    context.fillStyle = palette.ink;
    const gap = Math.max(6, this.px(34));
    let left = gap * 0.7;
    for (let i = 1; i < points.length; i += 1) {
      const [[ax, ay], [bx, by]] = [points[i - 1], points[i]];
      const length = Math.hypot(bx - ax, by - ay);
      while (left <= length && length > 0) {
        const share = left / length;
        this.arrowHead(context, ax + share * (bx - ax), ay + share * (by - ay), Math.atan2(by - ay, bx - ax), this.px(9));
        left += gap;
      }
      left -= length;
    }
    if (endSlot === null) {
      const [[ax, ay], [bx, by]] = points.slice(-2);
      this.arrowHead(context, bx, by, Math.atan2(by - ay, bx - ax), this.px(11));
      return;
    }
    this.outline(this.slots[endSlot], palette.ink, 2.2);
  }

  /** Draw the outline of a slot or a car. */
  outline({ x, y, yaw, length, width }, color, pixels) {
    const context = this.context;
    context.save();
    context.translate(x, y);
    context.rotate(yaw);
    context.strokeStyle = color;
    context.lineWidth = this.px(pixels);
    context.strokeRect(-length / 2, -width / 2, length, width);
    context.restore();
  }

  /** Write a name beside a slot. */
  drawName({ x, y }, name) {
    const context = this.context;
    const [middle, low] = this.toPixels([x, y]);
    const at = [middle, low - Math.max(12, 3.4 * this.at.scale)];
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.font = "600 12px system-ui, sans-serif";
    const width = context.measureText(name).width + 10;
    const left = Math.min(Math.max(at[0] - width / 2, 2), this.width - width - 2);
    const top = Math.max(at[1] - 16, 2);
    context.fillStyle = palette.ink;
    context.beginPath();
    context.roundRect(left, top, width, 17, 4);
    context.fill();
    context.fillStyle = palette.card;
    context.fillText(name, left + 5, top + 12.5);
    this.toMetres(context);
  }

  drawView(x, y, radius) {
    const context = this.context;
    context.fillStyle = palette.view;
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    context.fill();
  }

  drawDot(x, y, pixels, color) {
    const context = this.context;
    context.beginPath();
    context.arc(x, y, this.px(pixels), 0, 2 * Math.PI);
    context.fillStyle = color;
    context.fill();
    context.strokeStyle = palette.halo;
    context.lineWidth = this.px(1.6);
    context.stroke();
  }

  /** Draw the goal: a mark, or an arrow toward it at the edge. */
  drawGoal(x, y) {
    const context = this.context;
    const [across, up] = (this.turned ? [this.height, this.width] : [this.width, this.height]).map((pixels) => this.px(pixels) / 2);
    const [left, right, low, high] = [this.at.x - across, this.at.x + across, this.at.y - up, this.at.y + up];
    const edge = this.px(14);
    const at = [Math.min(Math.max(x, left + edge), right - edge), Math.min(Math.max(y, low + edge), high - edge)];
    if (at[0] !== x || at[1] !== y) {
      context.fillStyle = palette.goal;
      this.arrowHead(context, ...at, Math.atan2(y - at[1], x - at[0]), this.px(18));
      return;
    }
    this.drawDot(x, y, 8, palette.goal);
    this.drawDot(x, y, 3, palette.halo);
  }

  /** Draw a scale bar in the lower left corner. */
  drawScale() {
    const context = this.context;
    const raw = this.width / 7 / this.at.scale;
    const power = 10 ** Math.floor(Math.log10(raw));
    const metres = power * [5, 2, 1].find((step) => step * power <= raw);
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    const [x, y] = [10, this.height - 10];
    context.fillStyle = palette.card;
    context.globalAlpha = 0.72;
    context.beginPath();
    context.roundRect(x - 6, y - 13, metres * this.at.scale + 46, 19, 5);
    context.fill();
    context.globalAlpha = 1;
    context.strokeStyle = palette.soft;
    context.lineWidth = 1.5;
    context.lineCap = "butt";
    context.beginPath();
    context.moveTo(x, y - 4);
    context.lineTo(x, y);
    context.lineTo(x + metres * this.at.scale, y);
    context.lineTo(x + metres * this.at.scale, y - 4);
    context.stroke();
    context.fillStyle = palette.soft;
    context.font = "11px system-ui, sans-serif";
    context.fillText(`${metres} m`, x + metres * this.at.scale + 6, y + 1);
    this.toMetres(context);
  }
}
