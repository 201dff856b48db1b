// Tables: every number of the summary; click a heading, or press Enter on it, to sort.

/** Columns of a row that a phone shows at once. */
const AT_ONCE = 10;
/** Zones or blocks of a table that a page shows at once. */
const PLACES_AT_ONCE = 10;
const SETTING = ["scenario", "task", "test_scenario", "occupancy_level", "failure_cost_s", "v_walk_kmh", "v_drive_kmh"];

function sortValue(value) {
  if (Array.isArray(value)) return value[0];
  return value;
}

function compareValues(a, b) {
  const [x, y] = [sortValue(a), sortValue(b)];
  // Missing values come last in either order.
  if (x === null || x === undefined) return y === null || y === undefined ? 0 : Infinity;
  if (y === null || y === undefined) return -Infinity;
  if (typeof x === "string" || typeof y === "string") return String(x).localeCompare(String(y), "en", { numeric: true });
  return x - y;
}

function fillCell(cell, column, value) {
  cell.dataset.key = column.key;
  if (Array.isArray(value)) {
    cell.dataset.value = JSON.stringify(value);
    cell.append(asColumn(column, value[0]));
    if (value[1] !== null && value[2] !== null) {
      const ends = value.slice(1).map((end) => asColumn(column, end).replace(" %", "")).join(", ");
      cell.append(make("span", { class: "interval" }, `[${ends}]`));
    }
  } else {
    cell.dataset.value = JSON.stringify(value);
    cell.append(asColumn(column, value));
  }
  return cell;
}

/** "failure cost 10 s, walk 4 km/h" */
function settingInWords(columns, values) {
  return columns
    .map((column, i) => {
      if (values[i] === null) return null;
      const text = asColumn(column, values[i]) + (column.unit ? ` ${column.unit}` : "");
      return column.key === "scenario" ? text : `${column.label} ${text}`;
    })
    .filter((text) => text !== null)
    .join(", ");
}

function factsTable(table) {
  const body = make("tbody");
  table.columns.forEach((column, i) => {
    const cell = fillCell(make("td", { role: "cell" }), column, table.rows[0][i]);
    if (column.unit && typeof table.rows[0][i] === "number") cell.append(` ${column.unit}`);
    body.append(make("tr", { role: "row", "data-row": 0, title: column.help }, make("th", { role: "rowheader", scope: "row" }, column.label), cell));
  });
  // The style sheet lays it out in columns; the roles keep it a table for screen readers.
  return make("table", { role: "table", class: "facts", "data-table": table.name, "aria-label": table.title }, body);
}

/** Return which rows are folded away: those of all zones or blocks but the ten with the most cars, or the largest changes of all their cars. */
function foldedRows(columns, rows) {
  const at = (...keys) => keys.map((key) => columns.findIndex((column) => column.key === key)).find((k) => k >= 0);
  const [place, cars, change] = [at("block", "zone"), at("parked_a_day", "cars_a_day"), at("change_s")];
  if (place === undefined || cars === undefined) return rows.map(() => false);
  const number = (row, k) => Math.abs(sortValue(row[k]) ?? 0);
  const weights = new Map();
  for (const row of rows) {
    if (row[place] !== null) weights.set(row[place], (weights.get(row[place]) ?? 0) + number(row, cars) * (change === undefined ? 1 : 0.01 + number(row, change)));
  }
  const shown = new Set([...weights].sort((a, b) => b[1] - a[1]).slice(0, PLACES_AT_ONCE).map(([name]) => name));
  return rows.map((row) => weights.size > PLACES_AT_ONCE + 2 && row[place] !== null && !shown.has(row[place]));
}

function sortableTable(table) {
  const { rows } = table;
  const columns = table.columns.map((column, k) => ({ ...column, decimals: decimalsOf(column, rows.map((row) => row[k])) }));
  const body = make("tbody");
  const classOf = (k) => [isWord[k] ? "word" : "", k === lead || k === agent ? "lead" : "", settings.includes(k) ? "setting" : "", k === agent ? "agent" : "", k >= AT_ONCE && columns.length > AT_ONCE + 1 ? "minor" : ""].join(" ").trim() || null;
  const isWord = columns.map((_, i) => rows.every((row) => row[i] === null || typeof row[i] === "string"));
  const lead = columns.findIndex((column) => column.key === "total_s");
  const settings = columns.map((column, i) => (SETTING.includes(column.key) ? i : -1)).filter((i) => i >= 0);
  const agent = columns.findIndex((column) => column.key === "agent");
  const settingOf = (row) => JSON.stringify(settings.map((i) => row[i]));
  const lines = rows.map((row, i) => {
    const line = make("tr", { "data-row": i, class: table.leads?.includes(i) ? "leads" : null });
    columns.forEach((column, k) => {
      const value = column.key === "agent" || column.key === "model" ? shortName(String(row[k])) : row[k];
      const cell = make("td", { class: classOf(k), "data-label": column.label + (column.unit ? `, ${column.unit}` : "") });
      fillCell(cell, column, value);
      cell.dataset.value = JSON.stringify(row[k]);
      if (value !== row[k]) cell.title = row[k];
      line.append(cell);
    });
    if (columns.length > AT_ONCE + 1) {
      const [more, fewer] = [`All ${columns.length} columns`, "Fewer columns"];
      const button = make("button", { type: "button", "aria-expanded": "false", onclick: () => {
        const open = line.classList.toggle("open");
        button.textContent = open ? fewer : more;
        button.setAttribute("aria-expanded", String(open));
      } }, more);
      line.append(make("td", { class: "all" }, button));
    }
    return line;
  });
  body.append(...lines);

  const headings = columns.map((column, k) => {
    const arrow = make("span", { class: "arrow", "aria-hidden": "true" });
    const button = make("button", { type: "button", title: column.help }, column.label);
    if (column.unit) button.append(make("span", { class: "unit" }, ` ${column.unit}`));
    button.append(arrow);
    const heading = make("th", { scope: "col", class: classOf(k), "aria-sort": "none", "data-key": column.key }, button);
    button.addEventListener("click", () => {
      const down = heading.getAttribute("aria-sort") === "ascending";
      headings.forEach((other) => {
        other.setAttribute("aria-sort", "none");
        other.querySelector(".arrow").textContent = "";
      });
      heading.setAttribute("aria-sort", down ? "descending" : "ascending");
      arrow.textContent = down ? "↓" : "↑";
      const order = rows.map((_, i) => i);
      order.sort((a, b) => {
        const way = compareValues(rows[a][k], rows[b][k]);
        if (!Number.isFinite(way)) return way > 0 ? 1 : -1;
        return (down ? -way : way) || a - b;
      });
      body.append(...order.map((i) => lines[i]));
    });
    return heading;
  });
  const folded = foldedRows(columns, rows);
  lines.forEach((line, i) => line.classList.toggle("rest", folded[i]));
  const element = make("table", { class: folded.includes(true) ? "rows folded" : "rows", "data-table": table.name, "aria-label": table.title }, make("thead", {}, make("tr", {}, ...headings)), body);

  const groups = [...new Set(rows.map(settingOf))];
  if (agent < 0 || groups.length < 2 || groups.length > 24) return [element, null];
  const names = [["All", null], ...groups.map((group) => [settingInWords(settings.map((i) => columns[i]), JSON.parse(group)), group])];
  const chips = make("div", { class: "chips", role: "group", "aria-label": "Setting" });
  for (const [name, group] of names) {
    chips.append(
      make("button", {
        type: "button", class: "chip", "aria-pressed": String(group === null),
        onclick: (event) => {
          for (const chip of chips.children) chip.setAttribute("aria-pressed", String(chip === event.currentTarget));
          // The chosen setting need not be repeated in every row.
          element.classList.toggle("one-setting", group !== null);
          lines.forEach((line, i) => { line.hidden = group !== null && settingOf(rows[i]) !== group; });
        },
      }, name),
    );
  }
  if (window.innerWidth < 720) chips.children[1].click();
  return [element, chips];
}

function showTables(root, tables) {
  for (const table of tables) {
    if (!table.rows.length) continue;
    if (tables.length > 1) root.append(make("h3", {}, table.title));
    const same = settingInWords(table.same, table.same.map((column) => column.value));
    if (same) root.append(make("p", { class: "quiet" }, `In all rows: ${same}.`));
    const [element, chips] = table.facts ? [factsTable(table), null] : sortableTable(table);
    if (chips) root.append(chips);
    const box = make("div", { class: "card scroll", tabindex: 0, role: "region", "aria-label": table.title }, element);
    const hint = make("p", { class: "more", hidden: true }, "Scroll the table sideways for more columns →");
    root.append(hint, box);
    if (element.classList.contains("folded")) {
      const texts = [`All ${table.rows.length} rows`, `The ${PLACES_AT_ONCE} that matter most`];
      const button = make("button", { type: "button", class: "chip", "aria-expanded": "false", onclick: () => {
        const isFolded = element.classList.toggle("folded");
        button.textContent = texts[isFolded ? 0 : 1];
        button.setAttribute("aria-expanded", String(!isFolded));
      } }, texts[0]);
      root.append(make("div", { class: "chips after" }, button));
    }
    new ResizeObserver(() => { hint.hidden = box.scrollWidth <= box.clientWidth + 1; }).observe(box);
  }
}
