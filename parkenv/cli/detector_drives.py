"""`parkenv evaluate-detector --sessions`: detectors compared on whole survey drives."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table, progress_bar, save_summary
from parkenv.files.file_names import file_name
from parkenv.show.plurals import plural

if TYPE_CHECKING:
    from rich.table import Table

Row = dict[str, Any]


def compare_on_drives(
    drives: str,
    rigs: Sequence[str],
    detectors: Sequence[str],
    sessions: int,
    every: float,
    seed: int,
    misses: int,
    out: Path,
    machines: args.Machines,
) -> None:
    """Drive the sessions that the folder does not hold yet, print the comparison, and draw its figures.

    Raises:
        InputError: an invalid option, a scenario that cannot be made, or a folder that cannot be used.
    """
    from parkenv.files.csv_writing import write_csv
    from parkenv.perception.detector_registry import make_detector
    from parkenv.show.figures.detectors import save_misses, save_reach
    from parkenv.studies.sensing import detector_surveys as compared
    from parkenv.studies.sensing.surveys import survey_of
    from parkenv.studies.spec import SurveySpec

    spec = SurveySpec().changed(scenario=drives, sessions=sessions, every=every, seed=seed, **machines.given)
    for name in detectors:
        make_detector(name)
    its, settings = survey_of(spec)
    surveys = compared.detector_surveys(settings, rigs, detectors, out)
    console = make_console()
    with args.workers_of(spec) as workers, progress_bar(console, "drives") as progress:
        task = progress.add_task(
            "Driving (compiles first after an installation)", total=sessions * len(surveys)
        )
        driven = compared.run_detector_surveys(
            its, surveys, sessions, workers=workers, on_drive=lambda n: progress.advance(task, n)
        )
    table, reach = [], []
    for survey, of_survey in zip(surveys, driven, strict=True):
        table += compared.comparison_table(its, survey, of_survey)
        reach += compared.reach_table(survey, of_survey)
    write_csv(out / "table.csv", compared.TABLE_COLUMNS, table)
    ylabel = f"cars found in a picture, {its.name}, {plural(sessions, 'drive')}"
    save_reach(reach, ylabel, out / file_name(f"reach_{its.name}", ".png"))
    save_summary(out, seed, table, reach=reach, causes=compared.CAUSES)
    for printed in _tables(table, rigs, detectors):
        console.print(printed)
    if misses:
        with console.status("Drawing the missed cars once more"):
            chosen = [
                compared.choose_misses(survey, of_survey, misses, seed)
                for survey, of_survey in zip(surveys, driven, strict=True)
            ]
            of_rig = itertools.groupby(zip(surveys, chosen, strict=True), lambda s: s[0].settings.rig)
            for _, group in of_rig:
                sheets = list(group)
                wanted = {miss.picture for _, cars in sheets for miss in cars}
                pictures = compared.pictures_of(its, sheets[0][0].settings, wanted)
                for survey, cars in sheets:
                    rig, detector = survey.settings.rig, survey.settings.detector
                    rows = [
                        r for r in table if (r["rig"], r["detector"], r["group"]) == (rig, detector, "cause")
                    ]
                    title = f"Cars that {detector} missed in pictures of {its.name}, rig {rig}"
                    missed = compared.missed_by_cause(cars, pictures, rows)
                    save_misses(missed, title, out / f"misses_{survey.folder.name}.png")
    console.print(f"Written: {out / 'table.csv'}, summary.json, figures, and a map for each rig and detector")


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
