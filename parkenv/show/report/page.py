"""The report page: data, figures, style sheet and scripts in one self-contained HTML file."""

import html
import io
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from PIL import Image as PillowImage

from parkenv.files.atomic_write import write_text
from parkenv.files.images import image_text, read_image
from parkenv.show.figures.picture_files import CAPTION
from parkenv.show.report.drive_recording import data_uri
from parkenv.world.cost_terms import COST_TERMS

Row = Mapping[str, Any]

FORMAT, VERSION = "parkenv-report", 1  # JSON schema of the data in a page
# Scripts of the page, in order of dependence.
SCRIPTS = (
    "numbers.js", "tables.js", "time_chart.js", "learning_chart.js", "lot_view.js", "player.js", "search_track.js",
    "search_replay.js", "drive_replay.js", "fleet_replay.js", "town_map.js", "page.js",
)  # fmt: skip
# Scripts of a game's page.
GAME_SCRIPTS = ("numbers.js", "lot_view.js", "player.js", "search_track.js", "game_search.js", "game.js")
MOST_WIDTH = 1800  # px; wider figures are scaled down
LOSSLESS = 150_000  # bytes above which a figure is compressed lossily
_QUALITY = 86
_HERE = Path(__file__).parent
# The first figures of a page: prefixes of their file names.
_ORDER = (
    "time_split", "time_distribution", "time_against_occupancy", "time_against_failure_cost", "time_against_map",
    "searches", "session", "detections", "slots_found", "reach", "graph", "map", "learning_curve",
)  # fmt: skip
_WIDE = 2.2  # least ratio of width to height of a figure that has the page to itself, such as charts in a row
# Least white share of a chart, which is inverted in dark mode; pictures of lots and photographs are not.
_WHITE = 0.5


class Page(NamedTuple):
    title: str
    findings: Sequence[str] = ()  # a line each
    tables: Sequence[Mapping[str, Any]] = ()  # from `tables.table_of`
    learning: Sequence[Mapping[str, Any]] = ()  # see `TrainingStudy.page`


def page_data(
    kind: str,
    page: Page,
    summary: Mapping[str, Any],
    recordings: Sequence[Mapping[str, Any]] = (),
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Build the data of a page of a run of some kind (compare, survey, ...), without the figures.

    A recording is replayed: it has a `lot`, and on it a `world` with searches, a `drive`, or a day of a `fleet`; or a
    `town`, and a `map` of its day. Notes say, for instance, why there is no replay.
    """
    grounds: dict[str, list[Any]] = {"lot": [], "town": []}

    def placed(name: str, on: str = "lot") -> list[dict[str, Any]]:
        of_kind = [recording for recording in recordings if name in recording]
        for recording in of_kind:
            if recording[on] not in grounds[on]:
                grounds[on].append(recording[on])
        return [{**recording[name], on: grounds[on].index(recording[on])} for recording in of_kind]

    return {
        "format": FORMAT,
        "version": VERSION,
        "run": {
            "kind": kind,
            "title": page.title,
            "findings": list(page.findings),
            "command": shlex.join(str(word) for word in summary["command"]),
            "parkenv": summary["version"],
            "seed": summary.get("seed"),
            "notes": list(notes),
        },
        "terms": terms_data(),
        "learning": list(page.learning),
        "tables": list(page.tables),
        "worlds": placed("world"),
        "drives": placed("drive"),
        "fleets": placed("fleet"),
        "maps": placed("map", "town"),
        "lots": grounds["lot"],
        "towns": grounds["town"],
    }


def terms_data() -> list[dict[str, Any]]:
    return [{"name": t.name, "field": t.field, "label": t.label, "optional": t.optional} for t in COST_TERMS]


def write_page(data: Mapping[str, Any], path: Path, figures: Sequence[Path] = ()) -> None:
    shown = "\n".join(_figure(f) for f in sorted(figures, key=_rank))
    _write(path, "page.html", data, SCRIPTS, title=html.escape(data["run"]["title"]), figures=shown)


def write_game(data: Mapping[str, Any], path: Path) -> None:
    _write(path, "game.html", data, GAME_SCRIPTS, game=_part("game.css"))


def _write(path: Path, page: str, data: Mapping[str, Any], scripts: Iterable[str], **parts: str) -> None:
    # A "<" in a string must not end the script element that holds the data.
    embedded = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    style, program = _part("style.css") + _term_colors(), "\n".join(map(_part, scripts))
    write_text(path, Template(_part(page)).substitute(style=style, data=embedded, program=program, **parts))


def _part(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _term_colors() -> str:
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
    classes = " ".join(["plotted"] * white + ["wide"] * (width > _WIDE * height))
    return (
        f'<figure class="{classes}"><button type="button" class="enlarge" aria-label="Enlarge: {caption}">'
        f'<img src="{source}" width="{width}" height="{height}" alt="{caption}"></button>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _webp(picture: PillowImage.Image, *, chart: bool) -> str:
    content = io.BytesIO()
    if chart:
        picture.save(content, "WEBP", lossless=True)
    if not 0 < content.tell() <= LOSSLESS:
        content = io.BytesIO()
        picture.save(content, "WEBP", quality=_QUALITY)
    return data_uri("image/webp", content.getvalue())


def learning_panels(summary: Row, seeds: Sequence[Sequence[Row]]) -> list[dict[str, Any]]:
    """Return the panel of learning curves, of rows of each seed's `curve.csv`; none without curves.

    A point of the mean is decisions, mean, and the ends of its 95 % interval (None for one seed).
    """
    curve, lines = summary.get("curve"), summary.get("evaluated")
    if not curve or not isinstance(lines, Mapping):
        return []

    def points(rows: Sequence[Row], *names: str) -> list[list[Any]]:
        return [[row["steps"], *map(row.get, names)] for row in rows]

    return [{
        "title": "total time, s",
        "mean": points(curve, "total_s", "low_s", "high_s"),
        "seeds": [points([r for r in rows if {"steps", "total_s"} <= r.keys()], "total_s") for rows in seeds],
        "lines": [[name, value] for name, value in lines.items()],
    }]  # fmt: skip


def on_scenarios(rows: Sequence[Row], most: int = 4) -> str:
    """Return the scenarios of the rows of a summary, for a title; empty if they name none.

    Examples:
        >>> on_scenarios([{"scenario": "campus,street"}, {"scenario": "jam"}])
        ' on campus, street and jam'
    """
    names = [*dict.fromkeys(",".join(str(row["scenario"]) for row in rows if "scenario" in row).split(","))]
    return f" on {listed(names, most)}" if any(names) else ""


def listed(names: Sequence[str], most: int = 4) -> str:
    """Join names by commas and "and"; of more than `most`, the first ones and a count."""
    if len(names) > most:
        return f"{', '.join(names[:most])} and {len(names) - most} more"
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
