"""Compare agents that drive the car into slots, on the same tasks, with pictures and a film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from parkenv.files.atomic_write import make_folder
from parkenv.files.file_names import file_name
from parkenv.show.figures.parkings import save_parkings
from parkenv.show.figures.picture_files import save_film
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
from planners.agent import Agent
from planners.driving.parking_agents import make_parking_agent

SHOWN_FAILURES = 6


class ParkingComparison(NamedTuple):
    """What a comparison of parking agents has found.

    Attributes:
        labels: names of the agents by their short labels.
        rows: a row for each episode.
        table: a row for each agent, kind of slot and way of parking.
    """

    labels: Mapping[str, str]
    rows: list[Row]
    table: list[Row]


def compare_parking(
    cases: Sequence[ParkingCase],
    agents: Sequence[str],
    seeds: Sequence[int],
    folder: Path,
    *,
    workers: Workers = SERIAL,
    progress: Progress = lambda *_: None,
) -> ParkingComparison:
    """Let agents park with all seeds on all lots; write episodes.csv, pictures and a film into a folder.

    Args:
        cases: the tasks.
        agents: names for `make_parking_agent`.
        seeds: seeds of the tasks.
        folder: where the files go; those of several agents into one folder each.
        workers: where the episodes run.
        progress: called as episodes finish.

    Raises:
        InputError: an agent is unknown, or a lot has no slot of these kinds.
    """
    for case in cases:
        case.environment().close()
    labels = _labels(agents)
    parking_agents = {label: make_parking_agent(name, cases[0].vehicle) for label, name in labels.items()}
    parkings: dict[str, list[Parking]] = {label: [] for label in labels}
    for label, name in labels.items():
        doing = "Parking" if len(labels) == 1 else label
        total = len(cases) * len(seeds)
        progress(doing, 0, total)
        for some in park_all(cases, seeds, workers, name):
            parkings[label] += some
            progress(doing, len(parkings[label]), total)
    rows = [{"agent": label, **p.row} for label, its in parkings.items() for p in its]
    write_parkings(rows, folder / "episodes.csv")
    film = _to_film(next(iter(parkings.values())))
    for label, its in parkings.items():
        its_folder = folder if len(labels) == 1 else folder / file_name(label)
        make_folder(its_folder)
        _picture(its, cases, parking_agents[label], film, its_folder)
    table = [
        {"agent": label, **row}
        for label, its in parkings.items()
        for row in parking_table([p.row for p in its])
    ]
    return ParkingComparison(labels, rows, table)


def _labels(names: Sequence[str]) -> dict[str, str]:
    """Return a short label per agent, usable as a folder name, and the agent's full name."""
    labels: dict[str, str] = {}
    for name in names:
        word = name.partition(":")[0]
        alike = sum(known.partition(":")[0] == word for known in labels.values())
        labels[f"{word}-{alike + 1}" if alike else word] = name
    return labels


def _to_film(parkings: list[Parking]) -> dict[str, Any] | None:
    """Return the row of the successful episode with the most direction changes; None without success."""
    parked = [p.row for p in _one_of_each(parkings)]
    return max(parked, key=lambda row: row["direction_changes"], default=None)


def _one_of_each(parkings: list[Parking]) -> list[Parking]:
    """Return the first success per kind of slot and orientation."""
    kept = {(p.row["kind"], p.row["way"]): p for p in reversed(parkings) if p.row["parked"]}
    return [kept[key] for key in sorted(kept)]


def _picture(
    parkings: list[Parking],
    cases: Sequence[ParkingCase],
    agent: Agent,
    film: dict[str, Any] | None,
    folder: Path,
) -> None:
    """Write pictures of successes and failures, and an animation of the episode `film`."""
    lots = {case.lot.name: case.lot for case in cases}
    failures = [p for p in parkings if not p.row["parked"]][:SHOWN_FAILURES]
    for shown, name in ((_one_of_each(parkings), "parkings.png"), (failures, "failures.png")):
        if shown:
            save_parkings([(lots[p.row["lot"]], p.state) for p in shown], folder / name)
    if film is not None:
        case = next(case for case in cases if case.lot.name == film["lot"])
        frames = park_once(case.environment("rgb_array"), agent, film["seed"], every=2).frames
        save_film(frames, folder / "parking.gif", fps=10.0)
