// Mean total time: a stacked bar per agent with the confidence interval of its mean, a panel per setting.

/** Bars longer than this many times the shortest agent's of the panel may be cut off. */
const CUT = 2.6;

/** Return a round step that gives about `count` ticks. */
function tickStep(span, count) {
  const raw = span / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((step) => step * power >= raw);
}

function timePanel(rows, end, width) {
  const [left, right, line] = [104, 52, 25];
  const height = rows.length * line + 30;
  const x = (seconds) => left + (Math.min(seconds, end) / end) * (width - left - right);
  const svg = makeSvg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img" });
  const step = tickStep(end, 5);
  for (let tick = 0; tick <= end + 1e-9; tick += step) {
    svg.append(makeSvg("line", { class: "axis", x1: x(tick), x2: x(tick), y1: 0, y2: height - 24 }));
    const label = makeSvg("text", { x: x(tick), y: height - 8, "text-anchor": "middle" });
    label.textContent = `${tick}${tick === 0 ? " s" : ""}`;
    svg.append(label);
  }
  rows.forEach((row, i) => {
    const y = i * line + 5;
    const name = makeSvg("text", { x: left - 10, y: y + 12, "text-anchor": "end", class: row.leads ? "lead" : "strong" });
    name.textContent = shortName(row.agent);
    svg.append(name);
    let from = 0;
    for (const term of data.terms) {
      const to = from + (row[term.field] ?? 0);
      if (x(to) > x(from)) svg.append(makeSvg("rect", { x: x(from), y, width: x(to) - x(from), height: 15, style: `fill: ${termColor(term)}` }));
      from = to;
    }
    const [mean, low, high] = row.total_s;
    if (mean > end) {
      svg.append(makeSvg("path", { d: `M${x(end) - 9} ${y - 2}l5 19l4 0l-5 -19z`, style: "fill: var(--card)" }));
    } else if (low !== null && high !== null && high > low) {
      svg.append(makeSvg("line", { class: "whisker", x1: x(low), x2: x(high), y1: y + 7.5, y2: y + 7.5 }));
      for (const at of [low, high]) svg.append(makeSvg("line", { class: "whisker", x1: x(at), x2: x(at), y1: y + 4, y2: y + 11 }));
    }
    const total = makeSvg("text", { x: Math.min(x(Math.max(mean, mean > end ? mean : high ?? mean)) + 7, width - right + 7), y: y + 12, class: row.leads ? "lead" : "strong" });
    total.textContent = written(mean, 1);
    svg.append(total);
  });
  const bound = Math.min(...rows.map((row) => row.bound_s ?? Infinity));
  if (Number.isFinite(bound)) svg.append(makeSvg("line", { class: "bound", x1: x(bound), x2: x(bound), y1: 0, y2: height - 24 }));
  svg.setAttribute("aria-label", rows.map((row) => `${row.agent} ${written(row.total_s[0], 1)} s`).join(", "));
  return svg;
}

/** Draw the chart of a table that has the parts of the total time; returns whether it does. */
function showTimeChart(root, table) {
  const named = (row, i) => Object.fromEntries([["leads", table.leads?.includes(i)], ["unbeaten", table.unbeaten?.includes(i)], ...table.same.map((column) => [column.key, column.value]), ...table.columns.map((column, i) => [column.key, row[i]])]);
  const rows = table.rows.map(named);
  if (!rows.length || !rows.every((row) => Array.isArray(row.total_s) && "drive_s" in row && "agent" in row)) return false;
  const columns = [...table.same, ...table.columns].filter((column) => SETTING.includes(column.key)).sort((a, b) => SETTING.indexOf(a.key) - SETTING.indexOf(b.key));
  const varying = columns.filter((column) => new Set(rows.map((row) => row[column.key])).size > 1 || column.key === "scenario");
  const groups = new Map();
  for (const row of rows) {
    const key = JSON.stringify(columns.map((column) => row[column.key]));
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(row);
  }
  if (groups.size > 12) return false;
  // A few agents far off must not squash the others of their panel.
  const shown = [...groups.values()].flatMap((its) => {
    const shortest = Math.min(...its.filter((row) => !row.unbeaten).map((row) => row.total_s[0]));
    return its.map((row) => row.total_s[2] ?? row.total_s[0]).filter((seconds) => seconds <= CUT * shortest);
  });
  const longest = Math.max(...rows.map((row) => row.total_s[2] ?? row.total_s[0]));
  const raw = Math.max(...shown) * 1.02;
  const step = tickStep(Math.min(longest, raw), 5);
  const end = Math.ceil(raw / step) * step;
  const grid = make("div", { class: groups.size > 1 ? "grid" : "single" });
  // The size is fixed once; later the chart scales with the page.
  const width = Math.min(Math.max(root.clientWidth / (groups.size > 1 ? 2 : 1) - 60, 420), 900);
  for (const its of groups.values()) {
    const words = settingInWords(varying, varying.map((column) => its[0][column.key]));
    grid.append(make("div", {}, groups.size > 1 ? make("h3", {}, words) : null, timePanel(its, end, width)));
  }
  const used = data.terms.filter(({ field }) => rows.some((row) => row[field] > 0));
  const keys = used.map((term) => make("span", { class: "key" }, make("span", { class: "swatch", style: `background: ${termColor(term)}` }), term.label));
  const line = makeSvg("svg", { width: 22, height: 14 }, makeSvg("path", { class: "whisker", d: "M2 7H20M2 3V11M20 3V11", fill: "none" }));
  const dashes = makeSvg("svg", { width: 10, height: 16 }, makeSvg("line", { class: "bound", x1: 5, x2: 5, y1: 0, y2: 16 }));
  if (rows.some((row) => row.total_s[1] !== null)) keys.push(make("span", { class: "key" }, line, "95 % interval of the mean"));
  if (rows.some((row) => row.bound_s)) keys.push(make("span", { class: "key" }, dashes, "clairvoyant lower bound"));
  root.append(
    make("p", { class: "quiet" }, `Mean seconds from the entry of the lot to the goal; in bold, the agents that no other, the oracle apart, is shown to be faster than.${rows.some((row) => row.total_s[0] > end) ? " Bars far longer than the others are cut off." : ""}`),
    make("div", { class: "card chart" }, make("div", { class: "legend" }, ...keys), grid),
  );
  return true;
}
