"""Fitted curves to call, and the files in which other models read them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partialmethod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, nearest
from parkenv.files.atomic_write import write_text
from parkenv.files.csv_tables import csv_columns, csv_text, write_csv
from parkenv.files.limited_reading import read_json
from parkenv.studies.curve.fit import OUTCOMES, CurveTable, Paths, fit_form
from parkenv.studies.fleet.day import ALL
from parkenv.studies.results import Row, without_nan

JSON = "curve.json"
NAMES = ("scenario", "zone", "purpose", "hour")
PERIODS = {"": (0, 48), "_EA": (3, 5), "_AM": (5, 9), "_MD": (9, 14), "_PM": (14, 18), "_EV": (18, 27)}
"""Clock hours of the day, and of the time periods of ActivitySim's example (`network_los.yaml` of `prototype_mtc`)."""
MOST_BYTES = 500_000_000  # largest file of curves that is read
_DIGITS = 5


class CurveValue(NamedTuple):
    """Values of a curve, and the ends of their 95 % intervals, in the shape of the arguments."""

    value: FloatArray
    low: FloatArray
    high: FloatArray


class Curves:
    """Outcomes of a search by zone, purpose and hour, as functions of occupancy or demand.

    A curve is defined between the lowest and the highest simulated demand, and constant beyond these.

    Args:
        curves: by scenario, zone, purpose and hour, its columns: `occupancy`, `demand`, and value, low and high end of
            each outcome, as `search_s`, `search_s_low` and `search_s_high`.

    Raises:
        InputError: there are none.

    Examples:
        >>> its = {"occupancy": [0.2, 0.8], "demand": [0.1, 0.4]}
        >>> its |= {"search_s": [10.0, 70.0], "search_s_low": [8.0, 60.0], "search_s_high": [12.0, 80.0]}
        >>> Curves({("town", "all", "all", "all"): its}).search_s(occupancy=[0.2, 0.5, 0.9]).value
        array([10., 40., 70.])
    """

    def __init__(self, curves: Mapping[tuple[str, ...], Mapping[str, Sequence[float]]]) -> None:
        self.curves = dict(curves)
        if not self.curves:
            raise InputError("curves is empty, want at least one")

    def at(
        self,
        outcome: str,
        *,
        occupancy: ArrayLike | None = None,
        demand: ArrayLike | None = None,
        zone: Any = ALL,
        hour: Any = ALL,
        purpose: Any = ALL,
        scenario: Any = None,
    ) -> CurveValue:
        """Return an outcome, such as `search_s`, with its interval; all arguments broadcast against each other.

        Args:
            outcome: one of `parkenv.studies.curve.fit.OUTCOMES`.
            occupancy: share of the spaces around that is taken, from 0 to 1.
            demand: or instead, cars that arrive in an hour for each space around.
            zone: names of zones.
            hour: clock hours of the arrival.
            purpose: purposes.
            scenario: scenarios; None for the first.

        Raises:
            InputError: both or neither of occupancy and demand are given, or there is no such outcome or curve.
        """
        if (occupancy is None) == (demand is None):
            raise InputError("occupancy and demand are both given or both missing, want one of them")
        along, given = ("occupancy", occupancy) if demand is None else ("demand", demand)
        first = next(iter(self.curves))[0] if scenario is None else scenario
        x, *names = np.broadcast_arrays(np.asarray(given, float), first, zone, purpose, hour)
        values = np.empty((3, *x.shape))
        asked = np.stack([of_axis.astype(str) for of_axis in names], axis=-1)
        for key in {*map(tuple, asked.reshape(-1, len(NAMES)).tolist())}:
            at, curve = (asked == key).all(axis=-1), self._curve(key)
            if outcome not in curve:
                raise InputError(f"outcome is {outcome!r:.40}; {nearest(outcome, OUTCOMES)}")
            knots, unique = np.unique(np.array(curve[along], float), return_index=True)
            inside = np.clip(x[at], knots[0], knots[-1])
            for k, column in enumerate((outcome, f"{outcome}_low", f"{outcome}_high")):
                y = np.array(curve[column], float)[unique]
                values[k, at] = PchipInterpolator(knots, y)(inside) if len(knots) > 1 else y[0]
        return CurveValue(*values)

    def _curve(self, key: tuple[str, ...]) -> Mapping[str, Sequence[float]]:
        if key not in self.curves:
            for part, name, known in zip(NAMES, key, zip(*self.curves, strict=True), strict=True):
                if name not in known:
                    raise InputError(f"{part} is {name!r}; {nearest(name, dict.fromkeys(known))}")
            raise InputError(f"{', '.join(key)}: no cars come, so there is no curve")
        return self.curves[key]

    search_s = partialmethod(at, "search_s")
    walk_s = partialmethod(at, "walk_s")
    failed_attempts = partialmethod(at, "failed_attempts")
    balked_fraction = partialmethod(at, "balked_fraction")


def load_curves(folder: Path | str) -> Curves:
    """Read the curves in the folder of a run of `parkenv curve`.

    Raises:
        InputError: there are none, or the file is damaged.
    """
    path = Path(folder) / JSON
    content = read_json(path, MOST_BYTES)
    try:
        return Curves({tuple(str(curve[name]) for name in NAMES): curve for curve in content["curves"]})
    except (InputError, KeyError, TypeError) as error:
        raise InputError(f"{path}: want curves with {', '.join(NAMES)}") from error


def write_curves(paths: Paths, table: CurveTable, folder: Path) -> None:
    names, n = [paths.names(index) for index in table.numbers.tolist()], len(paths.multiples)
    columns = {name: values.round(_DIGITS).tolist() for name, values in table.columns.items()}
    repeated = [[name for name in of_axis for _ in range(n)] for of_axis in zip(*names, strict=True)]
    repeated += [
        paths.multiples.tolist() * len(names),
        *([x for row in rows for x in row] for rows in columns.values()),
    ]
    write_text(
        folder / "curve.csv",
        csv_text((*NAMES, "multiple", *columns), [], header=True) + csv_columns(repeated),
    )
    curves = [
        dict(zip(NAMES, key, strict=True)) | {name: values[k] for name, values in columns.items()}
        for k, key in enumerate(names)
    ]
    whole = without_nan({"multiples": paths.multiples.tolist(), "curves": curves})
    write_text(folder / JSON, json.dumps(whole, allow_nan=False) + "\n")
    terminal, links = zone_rows(paths, table)
    write_csv(folder / "activitysim.csv", tuple(terminal[0]), terminal)
    write_csv(folder / "matsim.csv", tuple(links[0]), links)


def zone_rows(paths: Paths, table: CurveTable) -> tuple[list[Row], list[Row]]:
    """Return a row of each zone for ActivitySim, and for MATSim.

    ActivitySim's land use has the terminal time, minutes: search and walk at `Paths.usual`, over the day and by period.
    MATSim's parking in QSim has spaces of links (each belongs to the nearest zone) and a `BellochePenaltyFunction`:
    alpha exp(-beta occupancy) s of search.
    """
    terminal, links, column = [], [], table.columns
    town, zone, purpose, hour = table.numbers.T
    of_all = (purpose == (-1 if len(paths.purposes) > 1 else 0)) & (hour >= 0) & (zone >= 0)
    for number, (name, zones) in enumerate(paths.towns.items()):
        minutes = (column["search_s"] + column["walk_s"])[:, paths.usual[name]] / 60.0
        for at, zone_name in enumerate(zones.names):
            hours = np.flatnonzero(of_all & (town == number) & (zone == at))
            if not hours.size:
                continue
            row: Row = {"scenario": name, "zone_id": zone_name}
            for period, (begin, end) in PERIODS.items():
                clock = paths.first_hour + hour[hours]
                inside = hours[(clock >= begin) & (clock < end)]
                weighed = np.average(minutes[inside], weights=table.cars[inside]) if inside.size else None
                row[f"TERMINAL{period}"] = weighed if weighed is None else round(float(weighed), 2)
            terminal.append(row)
            weight = np.repeat(table.cars[hours], len(paths.multiples))
            b, (alpha,) = fit_form(
                "a exp(b x)", column["occupancy"][hours].ravel(), column["search_s"][hours].ravel(), weight
            )
            x, y = zones.xy[at].round(2).tolist()
            row = {"scenario": name, "zone": zone_name, "x": x, "y": y}
            row |= dict(zip(("onstreet_spots", "offstreet_spots"), zones.own[at].tolist(), strict=True))
            links.append(row | {"alpha": round(float(alpha), _DIGITS), "beta": -b})
    return terminal, links
