"""`parkenv evaluate-detector --sessions`: detectors compared on whole survey drives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from parkenv.cli.tables import make_table
from parkenv.studies.results import Row

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from parkenv.studies.runner import Result


def show(console: Console, result: Result) -> None:
    """Print the comparison of detectors, once all have driven."""
    study: Any = result.study
    if result.complete:
        for printed in _tables(result.rows, study.rigs, study.detectors):
            console.print(printed)


def _tables(table: Sequence[Row], rigs: Sequence[str], detectors: Sequence[str]) -> list[Table]:
    """Return three tables: whole drives, drives by weather, and cars in pictures."""
    names = [(rig, detector) for rig in rigs for detector in detectors]
    headings = [f"{detector}, {rig}" for rig, detector in names]
    rows = {(r["rig"], r["detector"], r["group"], r["part"]): r for r in table}
    parts = list(dict.fromkeys((r["group"], r["part"]) for r in table))

    def line(heading: str, part: tuple[str, str], measure: str) -> tuple[str, ...]:
        return heading, *(_rate(rows[*name, *part], measure) for name in names)

    def numbers(heading: str, column: str) -> tuple[str, ...]:
        values = [rows[*name, "all", "all"][column] for name in names]
        return heading, *("" if value is None else f"{value:.3f}" for value in values)

    whole = ("all", "all")
    drives = [
        line("parked cars found", whole, "cars"),
        line("cars in a picture found in it", whole, "in_pictures"),
        line("boxes that are cars", whole, "boxes"),
        line("slots right", whole, "slots"),
        numbers("error of the place, m", "place_error_m"),
        numbers("mean error of the map", "map_error"),
    ]
    weathers = [
        line(f"{part}: {heading}".replace("_", " "), (group, part), measure)
        for heading, measure in (
            ("cars found", "cars"),
            ("boxes that are cars", "boxes"),
            ("slots right", "slots"),
        )
        for group, part in parts
        if group == "weather"
    ]
    pictures = [
        line(
            f"{part} ({rows[*names[0], group, part]['in_pictures']:,})".replace("_", " "),
            (group, part),
            "in_pictures",
        )
        for group, part in parts
    ]
    precision = [
        line(f"{part}: boxes that are cars", (group, part), "boxes")
        for group, part in parts
        if group == "distance"
    ]
    never = [
        (f"{part}: cars never found", *(str(rows[*name, "cause", part]["cars"]) for name in names))
        for group, part in parts
        if group == "cause"
    ]
    return [
        make_table("Whole drives", ["", *headings], drives),
        make_table("By weather", ["", *headings], weathers),
        make_table(
            "Cars in a picture that are found in it", ["", *headings], [*pictures, *precision, *never]
        ),
    ]


def _rate(row: Row, measure: str) -> str:
    rate, low, high = (row[f"{measure}_{c}"] for c in ("rate", "low", "high"))
    return "" if rate is None else f"{rate:.1%} [{100 * low:.1f}, {100 * high:.1f}]"
