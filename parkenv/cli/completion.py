"""Completion of values on the command line, from names and files alone: it has to answer at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from parkenv.files.known_names import (
    DETECTOR_SUFFIXES,
    DETECTORS,
    LOT_SUFFIXES,
    PACKAGED_LOTS,
    SCENARIO_NAMES,
    SENSOR_MODELS,
    VERIFY_CASES,
    WEATHERS,
)
from planners.names import AGENTS

Completer = Callable[[str], list[str]]


def completer(names: Sequence[str] = (), suffixes: Sequence[str] = (), several: bool = False) -> Completer:
    """Return a function that completes names, and files with one of the suffixes.

    Args:
        names: names to complete.
        suffixes: how names of files end; empty for none.
        several: complete the last of several values that are separated by commas.
    """

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",") if several else ("", "", incomplete)
        found = [name for name in names if name.startswith(last)]
        return [f"{before}{comma}{word}" for word in (*found, *_files(last, suffixes))]

    return complete


def _files(begun: str, suffixes: Sequence[str]) -> list[str]:
    """Return files with one of the suffixes, and folders, whose path begins like this."""
    if not suffixes:
        return []
    folder, slash, name = begun.rpartition("/")
    try:
        entries = sorted(Path(f"{folder}{slash}" or ".").iterdir())
    except OSError:
        return []
    return [
        f"{folder}{slash}{entry.name}{'/' if entry.is_dir() else ''}"
        for entry in entries
        if entry.name.startswith(name)
        and (name or entry.name[0] != ".")
        and (entry.is_dir() or entry.name.endswith(tuple(suffixes)))
    ]


_TABLES = (".toml", ".json")
COMPLETERS: dict[str, Completer] = {
    "agents": completer(tuple(AGENTS), several=True),
    "calibrated": completer((), (".json",)),
    "cases": completer(VERIFY_CASES, several=True),
    "clone": completer(tuple(AGENTS)),
    "detector": completer(DETECTORS, DETECTOR_SUFFIXES),
    "evaluate_on": completer(SCENARIO_NAMES, (*_TABLES, ".geojson"), several=True),
    "experiment": completer((), _TABLES),
    "lot": completer(PACKAGED_LOTS, LOT_SUFFIXES, several=True),
    "log": completer((), (".csv", ".csv.gz")),
    "mapping": completer((), (".csv",)),
    "map_file": completer((), (".sqlite",)),
    "model": completer(DETECTORS, DETECTOR_SUFFIXES),
    "occupancy": completer((), (".csv", ".csv.gz", ".json")),
    "place": completer((), (*LOT_SUFFIXES, ".osm", ".csv")),
    "places": completer((), LOT_SUFFIXES),
    "scenario": completer(SCENARIO_NAMES, (*_TABLES, ".geojson"), several=True),
    "sensor_model": completer(SENSOR_MODELS, (".json",)),
    "test_on": completer(SCENARIO_NAMES, (*_TABLES, ".geojson"), several=True),
    "weather": completer(WEATHERS, several=True),
}
"""How the values of an argument or option are completed."""
NAMES = {
    "agents": ", ".join(AGENTS),
    "cases": ", ".join(VERIFY_CASES),
    "scenarios": ", ".join(SCENARIO_NAMES),
    "weathers": ", ".join(WEATHERS),
}
"""Names that help texts list."""
