// The page: theme, sections, figures, and the command that reproduces the run.

const data = JSON.parse(document.getElementById("report-data").textContent);
const part = (id) => document.getElementById(id);
const repaint = [];

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  palette.read();
  for (const again of repaint) again();
}

const dark = matchMedia("(prefers-color-scheme: dark)");
setTheme(dark.matches ? "dark" : "light");
dark.addEventListener("change", () => setTheme(dark.matches ? "dark" : "light"));
part("theme").addEventListener("click", () => setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));

part("findings").append(...data.run.findings.map((finding) => make("li", {}, finding)));
part("notes").append(...data.run.notes.map((note) => make("p", { class: "note", role: "note" }, note)));

if (data.learning.length) {
  part("learning").hidden = false;
  showLearning(part("curves"), data.learning);
}

const main = data.tables.find((table) => table.name === "rows");
if (main) {
  part("overview").hidden = false;
  if (!showTimeChart(part("chart"), main)) part("overview").hidden = true;
}
showTables(part("tables"), data.tables);

if (data.worlds.length) {
  part("replay").hidden = false;
  const replay = new SearchReplay(part("search-replay"), data);
  repaint.push(() => replay.redraw());
}
if (data.maps.length) {
  part("town").hidden = false;
  const map = new TownMap(part("town-map"), data);
  repaint.push(() => map.redraw());
}
if (data.fleets.length) {
  part("crowd").hidden = false;
  const replay = new FleetReplay(part("fleet-replay"), data);
  repaint.push(() => replay.redraw());
}
if (data.drives.length) {
  part("drive").hidden = false;
  const replay = new DriveReplay(part("drive-replay"), data);
  repaint.push(() => { for (const view of replay.views) view.ground = null; replay.draw(); });
}

const figures = document.querySelectorAll("#figures figure");
part("figures").hidden = figures.length === 0;
const dialog = part("large");
for (const figure of figures) {
  figure.querySelector("button").addEventListener("click", () => {
    const image = figure.querySelector("img");
    dialog.querySelector("img").src = image.src;
    dialog.querySelector("img").alt = image.alt;
    dialog.classList.toggle("plotted", figure.classList.contains("plotted"));
    dialog.showModal();
  });
}
dialog.addEventListener("click", () => dialog.close());

const copy = make("button", { type: "button", onclick: async () => {
  try {
    await navigator.clipboard.writeText(data.run.command);
    copy.textContent = "Copied";
  } catch {
    getSelection().selectAllChildren(command);
    copy.textContent = "Selected";
  }
  setTimeout(() => { copy.textContent = "Copy"; }, 1600);
} }, "Copy");
const command = make("code", { id: "command" }, data.run.command);
const seed = data.run.seed === null ? "" : `, first seed ${data.run.seed}`;
part("run").append(
  make("div", { class: "card command" }, command, copy),
  make("p", { class: "quiet" }, `parkenv ${data.run.parkenv}${seed}. The same version and command reproduce all numbers except wall times.`),
);

for (const link of document.querySelectorAll("nav a")) link.hidden = part(link.dataset.for).hidden;
