// A lot from above on a canvas: what stays is drawn once for each size, what moves on top of it.

/** The colours of the page's theme, as the style sheet has them. */
const palette = {
  read() {
    const style = getComputedStyle(document.documentElement);
    for (const name of ["ground", "asphalt", "paint", "building", "wall", "parked", "glass", "car", "goal", "halo", "ink", "soft", "view", "card"]) {
      this[name] = style.getPropertyValue(`--${name}`).trim();
    }
    const anchors = style.getPropertyValue("--belief").split(",").map((hex) => hex.trim()).map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)));
    this.anchors = anchors;
    this.belief = Array.from({ length: 256 }, (_, value) => {
      const at = (value / 255) * (anchors.length - 1);
      const i = Math.min(Math.floor(at), anchors.length - 2);
      return `rgb(${anchors[i].map((a, c) => Math.round(a + (at - i) * (anchors[i + 1][c] - a))).join(" ")})`;
    });
  },
};

/** Metres that are shown around a car that is followed. */
const AROUND = 44;
const MARGIN = 2.5;

class LotView {
  constructor(canvas, lot) {
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

  /** Take on the canvas's width; the height follows from the lot. */
  resize() {
    const [x0, y0, x1, y1] = this.lot.bounds;
    const [across, up] = [x1 - x0 + 2 * MARGIN, y1 - y0 + 2 * MARGIN];
    const width = this.canvas.clientWidth || 600;
    const most = Math.min(Math.max(420, window.innerHeight * 0.62), 720);
    const height = this.follow ? Math.min(width * 0.72, most) : Math.min((width * up) / across, most);
    this.ratio = Math.min(window.devicePixelRatio || 1, 3);
    this.width = width;
    this.height = Math.round(height);
    this.canvas.style.height = `${this.height}px`;
    this.canvas.width = Math.round(width * this.ratio);
    this.canvas.height = Math.round(this.height * this.ratio);
    this.whole = { scale: Math.min(width / across, this.height / up), x: (x0 + x1) / 2, y: (y0 + y1) / 2 };
    this.ground = null;
  }

  /** Begin a picture; around a place where it is followed. */
  begin(place) {
    this.at = this.whole;
    if (this.follow && place) {
      const scale = Math.max(this.width / AROUND / 1.25, this.whole.scale);
      this.at = { scale, x: place[0], y: place[1] };
    }
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

  /** Coordinates in metres from now on, north up. */
  toMetres(context) {
    const { scale, x, y } = this.at;
    const k = this.ratio * scale;
    context.setTransform(k, 0, 0, -k, this.ratio * (this.width / 2 - scale * x), this.ratio * (this.height / 2 + scale * y));
  }

  /** So many pixels in metres. */
  px(pixels) {
    return pixels / this.at.scale;
  }

  drawGround(context) {
    const { lot, slots } = this;
    const { x, y, scale } = this.at;
    context.fillStyle = palette.ground;
    context.fillRect(x - this.width / scale, y - this.height / scale, (2 * this.width) / scale, (2 * this.height) / scale);
    const trace = (points) => {
      context.beginPath();
      for (let i = 0; i < points.length; i += 2) context.lineTo(points[i], points[i + 1]);
    };
    for (const wall of lot.walls) {
      trace(wall.points);
      if (wall.building) {
        context.fillStyle = palette.building;
        context.fill();
      }
      context.strokeStyle = palette.wall;
      context.lineWidth = Math.max(0.25, this.px(1));
      context.stroke();
    }
    context.strokeStyle = palette.asphalt;
    context.fillStyle = palette.asphalt;
    context.lineCap = "round";
    context.lineJoin = "round";
    for (const lane of lot.lanes) {
      trace(lane.points);
      context.lineWidth = 2 * lane.half_width;
      context.stroke();
    }
    // From each slot to where a car stops before it.
    context.lineCap = "butt";
    slots.forEach((slot, i) => {
      const [vx, vy] = lot.vertices[i];
      const along = Math.abs(Math.cos(Math.atan2(vy - slot.y, vx - slot.x) - slot.yaw)) > 0.7;
      context.lineWidth = (along ? slot.width : slot.length) + 0.5;
      context.beginPath();
      context.moveTo(slot.x, slot.y);
      context.lineTo(vx, vy);
      context.stroke();
      context.save();
      context.translate(slot.x, slot.y);
      context.rotate(slot.yaw);
      context.fillRect(-slot.length / 2 - 0.25, -slot.width / 2 - 0.25, slot.length + 0.5, slot.width + 0.5);
      context.restore();
    });
    context.strokeStyle = palette.paint;
    context.globalAlpha = 0.7;
    context.lineWidth = Math.max(0.12, this.px(0.6));
    for (const lane of lot.lanes) {
      if (lane.oneway) {
        for (let i = 2; i < lane.points.length; i += 2) this.laneArrows(context, ...lane.points.slice(i - 2, i + 2));
      } else {
        context.setLineDash([1.5, 2.5]);
        trace(lane.points);
        context.stroke();
        context.setLineDash([]);
      }
    }
    context.globalAlpha = 1;
    for (const [ex, ey] of lot.entries) {
      context.fillStyle = palette.soft;
      const r = this.px(4);
      context.beginPath();
      context.arc(ex, ey, r, 0, 2 * Math.PI);
      context.fill();
    }
  }

  laneArrows(context, ax, ay, bx, by) {
    const length = Math.hypot(bx - ax, by - ay);
    const n = Math.max(1, Math.round(length / 24));
    context.fillStyle = palette.paint;
    for (let i = 0; i < n; i += 1) {
      const share = (i + 0.5) / n;
      this.arrowHead(context, ax + share * (bx - ax), ay + share * (by - ay), Math.atan2(by - ay, bx - ax), 1.6);
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
   * All slots: filled with the belief, pale until seen, and a car where one stands.
   * belief(i) is 0 to 255, or -1 where nothing is known; seen(i), taken(i) are true or false.
   */
  drawSlots(belief, seen, taken) {
    const context = this.context;
    const line = Math.max(0.1, this.px(0.75));
    this.slots.forEach((slot, i) => {
      context.save();
      context.translate(slot.x, slot.y);
      context.rotate(slot.yaw);
      const [l, w] = [slot.length / 2 - line / 2, slot.width / 2 - line / 2];
      const value = belief(i);
      if (value >= 0) {
        context.globalAlpha = seen(i) ? 1 : 0.42;
        context.fillStyle = palette.belief[value];
        context.fillRect(-l, -w, 2 * l, 2 * w);
        context.globalAlpha = 1;
      }
      context.strokeStyle = palette.paint;
      context.lineWidth = line;
      context.strokeRect(-l, -w, 2 * l, 2 * w);
      if (taken(i)) this.parkedCar(context, Math.min(0.72 * slot.length, 4.2), Math.min(0.52 * slot.width, 1.6));
      context.restore();
    });
  }

  parkedCar(context, length, width) {
    context.fillStyle = palette.parked;
    context.beginPath();
    context.roundRect(-length / 2, -width / 2, length, width, 0.3 * width);
    context.fill();
    if (this.at.scale * width < 5) return;
    context.fillStyle = palette.glass;
    context.fillRect(0.1 * length, -0.36 * width, 0.13 * length, 0.72 * width);
    context.fillRect(-0.34 * length, -0.32 * width, 0.09 * length, 0.64 * width);
  }

  /** The car that is watched. */
  drawCar(x, y, yaw) {
    const context = this.context;
    const length = Math.max(4.4, this.px(15));
    const width = 0.46 * length;
    context.save();
    context.translate(x, y);
    context.rotate(yaw);
    context.fillStyle = palette.car;
    context.strokeStyle = "#1c2126";
    context.lineWidth = this.px(1.5);
    context.beginPath();
    context.roundRect(-length / 2, -width / 2, length, width, 0.32 * width);
    context.fill();
    context.stroke();
    context.fillStyle = "#1c2126";
    context.fillRect(0.08 * length, -0.34 * width, 0.15 * length, 0.68 * width);
    context.fillRect(-0.34 * length, -0.3 * width, 0.09 * length, 0.6 * width);
    context.restore();
  }

  /** A line through places, cased so that it is seen on any ground. */
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

  /** A plan: a line with arrows along it, and a ring where it ends. */
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

  /** The outline of a slot or a car. */
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

  /** Where people walk to: a mark, or at the edge an arrow toward it. */
  drawGoal(x, y) {
    const context = this.context;
    const [left, right] = [this.at.x - this.width / 2 / this.at.scale, this.at.x + this.width / 2 / this.at.scale];
    const [low, high] = [this.at.y - this.height / 2 / this.at.scale, this.at.y + this.height / 2 / this.at.scale];
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

  /** A bar of a round length in the lower left corner. */
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
