"""What of a run can be repeated for its report: searches, survey drives and days of fleets, from its specification."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from parkenv.files.spec_file import Spec
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.show.report.drive_recording import record_drive
from parkenv.studies.compare.cases import Case
from parkenv.studies.fleet.setting import Setting
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.replays import Replays
from parkenv.studies.report.fleet_recording import MOST_CARS
from parkenv.studies.report.run_folder import RunFolder
from parkenv.studies.report.search_recording import MOST_SLOTS
from parkenv.studies.study import Study
from parkenv.world.scenario import Scenario

Cases = list[tuple[Case, Sequence[int]]]
"""Searches: cases with their seeds."""


def replays_of(run: RunFolder, spec: Spec | None) -> Replays:
    """Return what a run can repeat; nothing without its specification.

    Raises:
        InputError, OSError: the run cannot be repeated.
    """
    if isinstance(spec, Study):
        return spec.replays(run.path)
    return Replays()


def repeat_drive(scenario: Scenario, settings: SurveySettings, number: int, frames: int) -> dict[str, Any]:
    """Repeat a survey drive, and return its recording."""
    return record_drive(Survey(scenario, settings), number, most_frames=frames)[1]


def drawable(cases: Sequence[tuple[Case, Sequence[int]]]) -> tuple[Cases, list[str]]:
    """Return the searches on lots that are small enough to draw, and notes on the others."""
    slots = {case.scenario.name: case.scenario.lot.n_slots for case, _ in cases}
    large = {name: n for name, n in slots.items() if n > MOST_SLOTS}
    notes = [
        f"{name} has {n} slots, more than the {MOST_SLOTS} that are drawn: no replay"
        for name, n in large.items()
    ]
    return [(case, its) for case, its in cases if case.scenario.name not in large], notes


def drawable_settings(fleets: FleetStudy, settings: Sequence[Setting]) -> tuple[list[Setting], list[str]]:
    """Return the settings with few enough cars, on a small enough lot, to draw, and notes on the others."""
    if (n := fleets.built.lot.n_slots) > MOST_SLOTS:
        return [], [f"the lot has {n} slots, more than the {MOST_SLOTS} that are drawn: no replay"]
    window = fleets.built.arrival
    most = MOST_CARS / ((window.end_s - window.start_s) / 3600.0)
    rates = dict.fromkeys(one.arrivals_per_hour for one in settings if one.arrivals_per_hour > most)
    notes = [
        f"days with {rate:g} cars an hour have more than the {MOST_CARS} cars that are drawn: no replay"
        for rate in rates
    ]
    return [one for one in settings if one.arrivals_per_hour <= most], notes


def differences(watched: Sequence[dict[str, Any]]) -> list[str]:
    """Return a note for every search whose total time differs from that in the results."""
    return [
        f"{search['agent']}, {e['world']['scenario']}, seed {e['world']['seed']}: run again it took "
        f"{search['total_s']:.2f} s, episodes.csv says {search['counted_s']:.2f} s"
        for e in watched
        for search in e["searches"]
        if search["agrees"] is False
    ]
