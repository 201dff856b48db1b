// Formatting of numbers and words.

const MINUS = "−";

/** Format a number with some digits; numbers of a thousand or more get none. */
function written(value, digits, signed = false) {
  if (value === null || value === undefined) return "–";
  const kept = Math.abs(value) >= 1000 ? 0 : digits;
  const text = Math.abs(value).toFixed(kept);
  const zero = Number(text) === 0;
  return (value < 0 && !zero ? MINUS : signed && !zero ? "+" : "") + text;
}

/** Format a value as its column specifies. */
function asColumn(column, value) {
  if (value === null || value === undefined) return "–";
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value === "string") return value;
  if (column.share) return `${written(100 * value, column.digits, column.signed)} %`;
  return written(value, column.decimals ?? decimalsOf(column, [value]), column.signed);
}

/** Return how many decimals all numbers of a column get. */
function decimalsOf(column, values) {
  const numbers = values.flat().filter((value) => typeof value === "number");
  if (numbers.every(Number.isInteger)) return column.digits > 1 ? 0 : column.digits;
  if (column.digits > 0 || !column.given) return column.digits;
  // A cost of 2.5 s must not be rounded where the others are whole numbers.
  return Math.max(...numbers.map((value) => (String(Number(value.toPrecision(4))).split(".")[1] ?? "").length));
}

const DAYS = ["Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun"];

/** Format seconds since Monday 00:00 as day and hour; days of a log keep their names. */
function moment(seconds, day) {
  const minutes = Math.floor((seconds % 86400) / 60);
  const name = typeof day === "string" && day !== "" ? day : DAYS[Math.floor(seconds / 86400) % 7];
  return `${name} ${String(Math.floor(minutes / 60)).padStart(2, "0")}:${String(minutes % 60).padStart(2, "0")}`;
}

/** Create an element from tag, attributes and children. */
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

function makeSvg(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Shorten a model's file name to its last folder. */
function shortName(agent) {
  const colon = agent.indexOf(":");
  if (colon < 0) return agent;
  const parts = agent.slice(colon + 1).split("/").filter((part) => part !== "model.zip");
  return `${agent.slice(0, colon)} ${parts.slice(-1)[0].replace("_", " ")}`;
}

/** An entry of a legend: a mark and what it means. */
function keyed(mark, text) {
  return make("span", { class: "key" }, mark, text);
}

/** A drawing for a legend, 16 px high. */
function markSvg(width, ...children) {
  return makeSvg("svg", { width, height: 16, viewBox: `0 0 ${width} 16`, "aria-hidden": "true" }, ...children);
}

/** Call redraw() when the width of an element changes. */
function onNewWidth(root, redraw) {
  let width = root.clientWidth;
  new ResizeObserver(() => {
    if (root.clientWidth === width) return;
    width = root.clientWidth;
    redraw();
  }).observe(root);
}
