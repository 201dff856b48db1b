"""Park on lots by the planner, with pictures and a film."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from parkenv.show.figures.manoeuvres import save_sheet
from parkenv.show.figures.picture_files import save_film
from parkenv.show.frames.drive import DriveRenderer
from parkenv.studies.results import Row
from parkenv.studies.study import Progress
from parkenv.studies.trips.parking_runs import (
    Parking,
    ParkingCase,
    park_all,
    park_once,
    parking_table,
    write_parkings,
)
from parkenv.studies.workers import SERIAL, Workers
from planners.driving.parking import ParkingAgent

SHOWN_FAILURES = 6


PLANNER = ParkingAgent.name


class ParkingResult(NamedTuple):
    """A row for each episode, and one for each kind of slot and way of parking."""

    rows: list[Row]
    table: list[Row]


def park_on_lots(
    cases: Sequence[ParkingCase],
    seeds: Sequence[int],
    folder: Path,
    *,
    workers: Workers = SERIAL,
    progress: Progress = lambda *_: None,
) -> ParkingResult:
    """Park with all seeds on all lots; write episodes.csv, pictures and a film into a folder.

    Args:
        cases: the tasks.
        seeds: seeds of the tasks.
        folder: where the files go.
        workers: where the episodes run.
        progress: called as episodes finish.
    """
    for case in cases:
        case.environment().close()
    total, parkings = len(cases) * len(seeds), list[Parking]()
    progress("Parking", 0, total)
    for some in park_all(cases, seeds, workers):
        parkings += some
        progress("Parking", len(parkings), total)
    rows = [{"agent": PLANNER, **p.row} for p in parkings]
    write_parkings(rows, folder / "episodes.csv")
    _picture(parkings, cases, folder)
    table = [{"agent": PLANNER, **row} for row in parking_table([p.row for p in parkings])]
    return ParkingResult(rows, table)


def _to_film(parkings: list[Parking]) -> dict[str, Any] | None:
    """Return the row of the successful episode with the most direction changes; None without success."""
    parked = [p.row for p in _one_of_each(parkings)]
    return max(parked, key=lambda row: row["direction_changes"], default=None)


def _one_of_each(parkings: list[Parking]) -> list[Parking]:
    """Return the first success per kind of slot and orientation."""
    kept = {(p.row["kind"], p.row["way"]): p for p in reversed(parkings) if p.row["parked"]}
    return [kept[key] for key in sorted(kept)]


def _picture(parkings: list[Parking], cases: Sequence[ParkingCase], folder: Path) -> None:
    """Write pictures of successes and failures, and an animation of one success."""
    lots = {case.lot.name: case.lot for case in cases}
    failures = [p for p in parkings if not p.row["parked"]][:SHOWN_FAILURES]
    for shown, name in ((_one_of_each(parkings), "parkings.png"), (failures, "failures.png")):
        if shown:
            save_sheet([DriveRenderer(lots[p.row["lot"]]).frame(p.state) for p in shown], folder / name)
    if (film := _to_film(parkings)) is not None:
        case = next(case for case in cases if case.lot.name == film["lot"])
        frames = park_once(
            case.environment("rgb_array"), ParkingAgent(case.vehicle), film["seed"], every=2
        ).frames
        save_film(frames, folder / "parking.gif", fps=10.0)
