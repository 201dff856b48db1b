"""The report page: data, figures, style sheet and scripts in one self-contained HTML file."""

from __future__ import annotations

import html
import io
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from PIL import Image as PillowImage

from parkenv.files.atomic_write import atomic_write
from parkenv.files.images import image_text, read_image
from parkenv.show.columns import SETTING_AXES
from parkenv.show.figures.picture_files import CAPTION
from parkenv.show.plurals import plural
from parkenv.show.report.drive_recording import data_uri
from parkenv.show.report.tables import tables_of
from parkenv.world.cost_terms import COST_TERMS

Row = Mapping[str, Any]

FORMAT, VERSION = "parkenv-report", 1
SCHEMA = Path(__file__).with_name("report.schema.json")
"""JSON schema of the data in a page."""
SCRIPTS = (
    "numbers.js", "tables.js", "time_chart.js", "learning_chart.js", "lot_view.js", "player.js", "search_replay.js",
    "drive_replay.js", "fleet_replay.js", "page.js",
)  # fmt: skip
"""Scripts of the page, in order of dependence."""
MOST_WIDTH = 1800
"""px; wider figures are scaled down."""
LOSSLESS = 150_000
"""Bytes above which a figure is compressed lossily."""
_QUALITY = 86
_HERE = Path(__file__).parent
_ORDER = (
    "time_split", "time_distribution", "time_against_occupancy", "time_against_failure_cost", "time_against_map",
    "searches", "session", "detections", "slots_found", "reach", "graph", "map", "learning_curve",
)  # fmt: skip
"""The first figures of a page: prefixes of their file names."""
_WHITE = 0.5
"""Least white share of a chart, which is inverted in dark mode; pictures of lots and photographs are not."""


def page_data(
    kind: str,
    summary: Mapping[str, Any],
    *,
    sessions: Sequence[Row] = (),
    learning: Sequence[Mapping[str, Any]] = (),
    encounters: Sequence[Mapping[str, Any]] = (),
    drives: Sequence[Mapping[str, Any]] = (),
    fleets: Sequence[Mapping[str, Any]] = (),
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Build the data of a page, without the figures; see `report.schema.json`.

    Args:
        kind: kind of the run: compare, survey, demo, train, ...
        summary: content of its `summary.json`.
        sessions: drives of a survey, rows of `sessions.csv`.
        learning: from `learning.learning_panels`.
        encounters: from `search_recording.record`.
        drives: from `drive_recording.record_drive`.
        fleets: from `fleet_recording.FleetDay.record`.
        notes: notes for the reader, such as why there is no replay.
    """
    lots: list[Any] = []

    def lot(described: Any) -> int:
        if described not in lots:
            lots.append(described)
        return lots.index(described)

    return {
        "format": FORMAT,
        "version": VERSION,
        "run": {
            "kind": kind,
            "title": _title(kind, summary),
            "findings": _findings(kind, summary),
            "command": shlex.join(str(word) for word in summary["command"]),
            "parkenv": summary["version"],
            "seed": summary.get("seed"),
            "notes": list(notes),
        },
        "terms": terms(),
        "learning": list(learning),
        "tables": tables_of(kind, summary, sessions),
        "lots": lots,
        "worlds": [{**e["world"], "lot": lot(e["lot"]), "searches": e["searches"]} for e in encounters],
        "drives": [{**d["drive"], "lot": lot(d["lot"])} for d in drives],
        "fleets": [{**f["fleet"], "lot": lot(f["lot"])} for f in fleets],
    }


def terms() -> list[dict[str, Any]]:
    """Return what a step can cost, for the legends of a page."""
    return [{"name": t.name, "field": t.field, "label": t.label, "optional": t.optional} for t in COST_TERMS]


def write_page(data: Mapping[str, Any], path: Path, figures: Sequence[Path] = ()) -> None:
    """Write the page atomically.

    Args:
        data: data from `page_data`.
        path: the HTML file to write.
        figures: PNG files to show.

    Raises:
        InputError: the file cannot be written.
    """
    # A "<" in a string must not end the script element that holds the data.
    embedded = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    text = Template((_HERE / "page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(data["run"]["title"]),
        style=(_HERE / "style.css").read_text(encoding="utf-8") + _term_colors(),
        figures="\n".join(_figure(f) for f in sorted(figures, key=_rank)),
        data=embedded,
        program="\n".join((_HERE / name).read_text(encoding="utf-8") for name in SCRIPTS),
    )
    with atomic_write(path) as beside:
        beside.write_text(text, encoding="utf-8")


def _term_colors() -> str:
    """Return the style sheet of the colours of the costs: a variable for each term, `--gave-up` for `gave_up`."""

    def variables(colors: Iterable[str]) -> str:
        return " ".join(
            f"--{term.name.replace('_', '-')}: {color};"
            for term, color in zip(COST_TERMS, colors, strict=True)
        )

    light, dark = (term.color for term in COST_TERMS), (term.dark_color for term in COST_TERMS)
    return f':root {{ {variables(light)} }}\n:root[data-theme="dark"] {{ {variables(dark)} }}\n'


def _rank(path: Path) -> int:
    return next((i for i, prefix in enumerate(_ORDER) if path.name.startswith(prefix)), len(_ORDER))


def _figure(path: Path) -> str:
    picture = PillowImage.fromarray(read_image(path)).convert("RGB")
    caption = html.escape(image_text(path, CAPTION) or path.stem.replace("_", " "))
    if picture.width > MOST_WIDTH:
        picture = picture.resize((MOST_WIDTH, round(picture.height * MOST_WIDTH / picture.width)))
    white = bool((np.asarray(picture).min(axis=2) > 250).mean() > _WHITE)
    source, (width, height) = _webp(picture, chart=white), picture.size
    return (
        f'<figure{" class=plotted" * white}><button type="button" class="enlarge" aria-label="Enlarge: {caption}">'
        f'<img src="{source}" width="{width}" height="{height}" alt="{caption}"></button>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _webp(picture: PillowImage.Image, *, chart: bool) -> str:
    """Encode as WebP: charts lossless if the result is small, everything else lossy."""
    content = io.BytesIO()
    if chart:
        picture.save(content, "WEBP", lossless=True)
    if not 0 < content.tell() <= LOSSLESS:
        content = io.BytesIO()
        picture.save(content, "WEBP", quality=_QUALITY)
    return data_uri("image/webp", content.getvalue())


def _title(kind: str, summary: Mapping[str, Any]) -> str:
    named = [str(row["scenario"]).split(",") for row in summary["rows"] if "scenario" in row]
    names = list(dict.fromkeys(name for its in named for name in its))
    where = f" on {_listed(names)}" if names else ""
    if kind == "compare":
        return f"Agents compared{where}"
    if kind == "commute":
        return f"Maps that learn from every trip{where}"
    if kind == "fleet":
        return f"Many cars{where}"
    if kind == "survey":
        return f"Survey{where}"
    if kind == "demo":
        return f"From a survey to a search{where}"
    if kind == "train":
        return f"{_listed(list(dict.fromkeys(str(r.get('agent', 'agent')) for r in summary['rows'])))} trained{where}"
    return f"parkenv {kind}"


def _listed(names: Sequence[str], most: int = 4) -> str:
    if len(names) > most:
        return f"{', '.join(names[:most])} and {len(names) - most} more"
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _findings(kind: str, summary: Mapping[str, Any]) -> list[str]:
    """Summarise the results in sentences."""
    if kind == "compare":
        return _comparison_findings(summary["rows"])
    if kind == "fleet":
        return _fleet_findings(summary["rows"])
    if kind == "survey":
        return [_survey_finding(row) for row in summary["rows"]]
    if kind == "demo":
        return [_survey_finding(summary["survey"]), *_comparison_findings(summary["rows"])]
    if kind == "train":
        return _training_findings(summary)
    return []


def _fleet_findings(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for each agent and demand: what competition costs, and what the best guidance saves."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["agents"], row["arrivals_per_hour"]), []).append(row)
    findings = []
    for (agent, per_hour), its in groups.items():
        own = next((row for row in its if row["knows"] == "own"), its[0])
        finding = (
            f"{agent}, {per_hour:g} cars an hour, {own['occupancy']:.0%} of the slots taken: {own['total_s']:.1f} s a "
            f"car, {own['balked_fraction']:.1%} find no slot"
        )
        interval = own["price_of_anarchy_ci95"]
        if own["price_of_anarchy"] is not None and None not in interval and own["knows"] == "own":
            finding += f"; the price of anarchy is {own['price_of_anarchy']:.3f} [{interval[0]:.3f}, {interval[1]:.3f}]"
        findings.append(f"{finding}.")
    return findings


def _training_findings(summary: Mapping[str, Any]) -> list[str]:
    rows = [row for row in summary["rows"] if isinstance(row.get("total_s"), float)]
    if not rows:
        return []
    times = sorted(row["total_s"] for row in rows)
    name = rows[0]["scenario"]
    between = f"{times[0]:.1f} s"
    if len(times) > 1:
        between = f"{times[0]:.1f} to {times[-1]:.1f} s over {len(times)} trainings"
    finding = f"Tested on {name} in held-out worlds, the models take {between}"
    planners = [row for row in summary.get("planners", []) if row["scenario"] == name]
    if planners:
        best = min(planners, key=lambda row: float(row["total_s"]))
        finding += f"; the best planner there, {best['agent']}, takes {best['total_s']:.1f} s"
    return [f"{finding}."]


def _survey_finding(row: Row) -> str:
    return (
        f"{plural(row['sessions'], 'drive')} past {plural(row['slots'], 'slot')}: "
        f"{row['car_detection_rate']:.1%} of the parked cars were detected, {row['slot_accuracy']:.1%} of the slots "
        "classified correctly."
    )


def _comparison_findings(rows: Sequence[Row]) -> list[str]:
    settings: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        settings.setdefault((row["scenario"], *(row[name] for name in SETTING_AXES)), []).append(row)
    findings = []
    speeds = len({key[2:] for key in settings}) > 1
    for (name, failure, walk, drive), its in settings.items():
        agents = [row for row in its if row["agent"] != "oracle"]
        if len(agents) < 2:
            continue
        best = min(agents, key=lambda row: float(row["total_s"]))
        at = f", walking at {walk:g} and driving at {drive:g} km/h" if speeds else ""
        interval = best["total_s_ci95"]
        between = f" [{interval[0]:.1f}, {interval[1]:.1f}]" if None not in interval else ""
        findings.append(
            f"{name}, failure cost {failure:g} s{at}: {best['agent']} has the lowest mean total time, "
            f"{best['total_s']:.1f} s{between}; the clairvoyant lower bound is {best['bound_s']:.1f} s."
        )
    return findings
