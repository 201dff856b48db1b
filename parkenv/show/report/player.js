// Playback: a slider, play and pause, steps between recorded moments, the keyboard.

const ICONS = {
  play: "M4 2.5v11l9.5-5.5z",
  pause: "M3.5 2.5h3.4v11H3.5zM9.1 2.5h3.4v11H9.1z",
  back: "M12.5 2.5v11L4.5 8zM2.5 2.5h1.8v11H2.5z",
  on: "M3.5 2.5v11L11.5 8zM11.7 2.5h1.8v11h-1.8z",
  first: "M8.5 8l5.5-5v10zM3 8l5.5-5v10z",
};

function icon(name) {
  return makeSvg("svg", { viewBox: "0 0 16 16", "aria-hidden": "true" }, makeSvg("path", { d: ICONS[name] }));
}

/** The player that receives keys: the last one used, else the first. */
let active = null;

class Player {
  /** show(seconds) is called when the time changes; describe(seconds) returns it as text. */
  constructor(root, { show, describe, speeds, speed, name }) {
    this.show = show;
    this.describe = describe;
    this.seconds = 0;
    this.playing = false;
    this.slider = make("input", { type: "range", min: 0, max: 1, step: 0.01, value: 0, "aria-label": `Time in the ${name}` });
    this.output = make("output", {});
    this.playKey = make("button", { type: "button", class: "play", "aria-label": "Play", title: "Play or pause (space)" }, icon("play"));
    const firstKey = make("button", { type: "button", "aria-label": "To the start", title: "To the start (Home)" }, icon("first"));
    const backKey = make("button", { type: "button", class: "step-back", "aria-label": "Step back", title: "Step back (←)" }, icon("back"));
    const onKey = make("button", { type: "button", class: "step-on", "aria-label": "Step forward", title: "Step forward (→)" }, icon("on"));
    this.speedChoice = make("select", { "aria-label": "Speed" }, ...speeds.map((s) => make("option", { value: s, selected: s === speed }, `${s}×`)));
    this.time = make("div", { class: "time" }, this.slider);
    const hint = make("span", { class: "hint" }, make("kbd", {}, "space"), " play   ", make("kbd", {}, "←"), " ", make("kbd", {}, "→"), " step   ", make("kbd", {}, "Home"), " start");
    this.keys = make("div", { class: "keys" }, firstKey, backKey, this.playKey, onKey, this.output, this.speedChoice, hint);
    this.slider.addEventListener("input", () => { this.pause(); this.goTo(Number(this.slider.value)); });
    this.playKey.addEventListener("click", () => this.toggle());
    firstKey.addEventListener("click", () => { this.pause(); this.goTo(0); });
    backKey.addEventListener("click", () => this.step(-1));
    onKey.addEventListener("click", () => this.step(1));
    root.addEventListener("pointerdown", () => { active = this; });
    root.addEventListener("focusin", () => { active = this; });
    active ??= this;
  }

  /** Load a recording: its duration, and the moments to step between. */
  load(duration, stops) {
    this.pause();
    this.duration = duration;
    this.stops = [...new Set([0, ...stops, duration])].sort((a, b) => a - b);
    this.slider.max = duration;
    this.goTo(0);
  }

  goTo(seconds) {
    this.seconds = Math.min(Math.max(seconds, 0), this.duration);
    this.slider.value = this.seconds;
    const words = this.describe(this.seconds);
    this.slider.setAttribute("aria-valuetext", words);
    this.output.textContent = words;
    this.show(this.seconds);
  }

  step(way) {
    this.pause();
    const next = way > 0 ? this.stops.find((s) => s > this.seconds + 1e-6) : this.stops.findLast((s) => s < this.seconds - 1e-6);
    if (next !== undefined) this.goTo(next);
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  play() {
    if (this.seconds >= this.duration) this.goTo(0);
    this.playing = true;
    this.face("pause", "Pause");
    let before = null;
    const tick = (now) => {
      if (!this.playing) return;
      if (before !== null) this.goTo(this.seconds + ((now - before) / 1000) * Number(this.speedChoice.value));
      before = now;
      if (this.seconds >= this.duration) this.pause();
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  pause() {
    this.playing = false;
    this.face("play", "Play");
  }

  face(name, label) {
    this.playKey.replaceChildren(icon(name));
    this.playKey.setAttribute("aria-label", label);
  }
}

document.addEventListener("keydown", (event) => {
  const target = event.target;
  const typing = target.closest?.("select, textarea, input:not([type=range]), dialog, .scroll");
  if (!active || typing || event.ctrlKey || event.metaKey || event.altKey) return;
  const pressed = target.closest?.("button, a");
  if (event.key === " " && !pressed) active.toggle();
  else if (event.key === "ArrowRight") active.step(1);
  else if (event.key === "ArrowLeft") active.step(-1);
  // At the start, Home scrolls to the top of the page as usual.
  else if (event.key === "Home" && (active.seconds > 0 || target.type === "range")) { active.pause(); active.goTo(0); }
  else return;
  event.preventDefault();
});
