// Learning curves: the mean over trainings with its interval, single trainings as thin lines, planners dashed.

/** Times above this multiple of the least one are off the chart: an untrained policy drives in circles. */
const OFF_CHART = 2;

/** Move positions apart to a least distance, in order, as little as possible. */
function spread(positions, apart) {
  const placed = [...positions];
  for (let round = 0; round < 60; round += 1) {
    for (let i = 1; i < placed.length; i += 1) {
      const overlap = apart - (placed[i] - placed[i - 1]);
      if (overlap > 0) {
        placed[i - 1] -= overlap / 2;
        placed[i] += overlap / 2;
      }
    }
  }
  return placed;
}

function learningPanel({ title, mean, seeds, lines }, width) {
  const [height, left, right, top, bottom] = [340, 46, 150, 10, 34];
  const curves = seeds.flat();
  const steps = Math.max(...mean.map((point) => point[0]), ...curves.map((point) => point[0]), 1);
  const all = [...mean.map((point) => point[1]), ...curves.map((point) => point[1]), ...lines.map((line) => line[1])].filter((value) => value !== null);
  let [low, high] = [Math.min(...all), Math.max(...all)];
  high = Math.min(high, OFF_CHART * low);
  const margin = 0.06 * (high - low);
  [low, high] = [low - margin, high + margin];
  const x = (value) => left + (value / steps) * (width - left - right);
  const y = (value) => top + ((high - value) / (high - low)) * (height - top - bottom);
  const svg = makeSvg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${title}: ${lines.map((line) => `${line[0]} ${written(line[1], 1)}`).join(", ")}; trained ${written(mean[mean.length - 1][1], 1)}` });
  const text = (content, attributes) => {
    const element = makeSvg("text", attributes);
    element.textContent = content;
    svg.append(element);
  };
  const gap = tickStep(high - low, 5);
  for (let tick = Math.ceil(low / gap) * gap; tick <= high; tick += gap) {
    svg.append(makeSvg("line", { class: "axis", x1: left, x2: width - right, y1: y(tick), y2: y(tick) }));
    text(`${Math.round(tick)}${tick + gap > high ? " s" : ""}`, { x: left - 8, y: y(tick) + 4, "text-anchor": "end" });
  }
  const along = tickStep(steps, 4);
  for (let tick = 0; tick <= steps; tick += along) {
    text(tick >= 1e6 ? `${tick / 1e6} M` : tick >= 1e3 ? `${tick / 1e3} k` : `${tick}`, { x: x(tick), y: height - bottom + 18, "text-anchor": "middle" });
  }
  text("decisions in training", { x: x(steps / 2), y: height - 1, "text-anchor": "middle" });
  const clip = `clip${Math.random().toString(36).slice(2)}`;
  svg.append(makeSvg("clipPath", { id: clip }, makeSvg("rect", { x: left, y: top, width: width - left - right, height: height - top - bottom })));
  const drawn = makeSvg("g", { "clip-path": `url(#${clip})` });
  const path = (points) => points.map(([a, b], i) => `${i ? "L" : "M"}${x(a).toFixed(1)} ${y(b).toFixed(1)}`).join("");
  const sure = mean.filter((point) => point[2] !== null && point[3] !== null && point[2] !== undefined);
  if (sure.length > 1) drawn.append(makeSvg("path", { d: `${path(sure.map((p) => [p[0], p[3]]))}${path([...sure].reverse().map((p) => [p[0], p[2]])).replace("M", "L")}Z`, style: "fill: var(--drive); opacity: 0.18" }));
  for (const its of seeds) drawn.append(makeSvg("path", { d: path(its), style: "fill: none; stroke: var(--drive); stroke-width: 1; opacity: 0.4" }));
  drawn.append(makeSvg("path", { d: path(mean.map((p) => [p[0], p[1]])), style: "fill: none; stroke: var(--drive); stroke-width: 2.6; stroke-linejoin: round" }));
  svg.append(drawn);
  const last = mean[mean.length - 1][1];
  const labels = [...lines.map(([name, value]) => ({ name, value })), { name: "trained", value: last, strong: true }].filter(({ value }) => value <= high && value >= low);
  labels.sort((a, b) => b.value - a.value);
  const heights = spread(labels.map(({ value }) => y(value)), 17);
  labels.forEach(({ name, value, strong }, i) => {
    if (!strong) svg.append(makeSvg("line", { class: "bound", x1: left, x2: width - right, y1: y(value), y2: y(value) }));
    svg.append(makeSvg("path", { d: `M${width - right + 2} ${y(value)}L${width - right + 12} ${heights[i]}`, style: "fill: none; stroke: var(--faint); stroke-width: 0.8" }));
    text(`${name}  ${written(value, 1)}`, { x: width - right + 16, y: heights[i] + 4, class: strong ? "lead" : "strong" });
  });
  return svg;
}

function showLearning(root, panels) {
  const n = Math.max(...panels.map((panel) => panel.seeds.length));
  const grid = make("div", { class: panels.length > 1 ? "grid" : "single" });
  const width = Math.min(Math.max(root.clientWidth / Math.min(panels.length, 2) - 40, 420), 1200);
  for (const panel of panels) grid.append(make("div", {}, make("h3", {}, panel.title), learningPanel(panel, width)));
  root.append(
    make("p", { class: "quiet" }, `Evaluations during training, in held-out worlds: the mean over ${n} training${n > 1 ? "s with its 95 % interval, each training as a thin line" : ""}. Dashed: other agents in the same worlds.`),
    make("div", { class: "card chart" }, grid),
  );
}
