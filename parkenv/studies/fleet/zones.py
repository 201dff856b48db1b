"""Use, occupancy and revenue of the tariff zones of a lot, on days with many cars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.engine.fleet import Fleet
from parkenv.files.csv_tables import NUMBER_OR_NAN, TEXT, WHOLE
from parkenv.studies.fleet.setting import KINDS, SETTING_COLUMNS
from parkenv.studies.fleet.tables import day_means
from parkenv.studies.results import CsvTable, Row
from parkenv.world.scenario import Scenario
from parkenv.world.tariff import HOUR_S, NO_ZONE
from parkenv.world.week import DAY_S

ZONES = CsvTable(
    "zones.csv",
    keys=(*SETTING_COLUMNS, "day", "zone", "hour"),
    columns=("slots", "price", "parked", "occupancy", "paid"),
    kinds={
        **KINDS,
        **dict.fromkeys(("hour", "slots", "parked"), WHOLE),
        "zone": TEXT,
        "occupancy": NUMBER_OR_NAN,
    },
    lists=None,
)
"""What happens in each zone in each hour of a day: cars that park, their stays paid in full, slots taken."""
MEANS = ("occupancy", "parked_a_day", "share_parked", "paid_a_day", "paid_a_car")
"""Columns of a zone that are means over days, with 95 % intervals."""


def has_zones(scenario: Scenario) -> bool:
    """Return whether there is something to say of zones."""
    return bool(scenario.tariff) or scenario.lot.zones != (NO_ZONE,)


def paid(fleet: Fleet) -> FloatArray:
    """Return what each car of a day whose searches are over pays, (n_cars,), in the currency of the prices."""
    lot, cars = fleet.scenario.lot, fleet.cars
    zone = lot.zone_of_slot[cars["slot"]]
    amounts = fleet.scenario.tariff.amounts(lot.zones, cars["stay_s"])[np.arange(len(cars)), zone]
    return np.where(cars["slot"] >= 0, amounts, 0.0)


def zone_rows(fleet: Fleet, times: FloatArray, taken: BoolArray) -> list[Row]:
    """Return the rows of `ZONES` of a day whose searches are over, without setting and day.

    Args:
        fleet: the fleet.
        times: (n,) s since Monday 00:00, at which slots were looked at.
        taken: (n, n_slots) which were taken.
    """
    scenario, cars = fleet.scenario, fleet.cars
    amounts, parked, lot = paid(fleet), cars["slot"] >= 0, scenario.lot
    zone_of_car, hour_of_car, hour_of_look = (
        lot.zone_of_slot[cars["slot"]],
        *map(_hour, (cars["ended_at"], times)),
    )
    rows = []
    for zone, name in enumerate(lot.zones):
        slots = lot.zone_of_slot == zone
        for hour in np.union1d(hour_of_look, hour_of_car[parked]):
            its, looks = parked & (zone_of_car == zone) & (hour_of_car == hour), taken[hour_of_look == hour]
            rows.append(
                {
                    "zone": name,
                    "hour": int(hour),
                    "slots": int(slots.sum()),
                    "price": scenario.tariff.per_hour.get(name, 0.0),
                    "parked": int(its.sum()),
                    "occupancy": float(looks[:, slots].mean()) if len(looks) else float("nan"),
                    "paid": float(amounts[its].sum()),
                }
            )
    return rows


def _hour(time: FloatArray) -> NDArray[np.int64]:
    return np.asarray(time % DAY_S // HOUR_S, np.int64)


def summarize_zones(rows: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Return a row for each zone in each setting, from rows of `ZONES`: means over days, with 95 % intervals.

    Occupancy is that while cars arrive; `share_parked` is the share of the parked cars that are in the zone.
    """
    by_day: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        by_day.setdefault(tuple(row[name] for name in (*SETTING_COLUMNS, "zone", "day")), []).append(row)
    parked: dict[tuple[Any, ...], int] = {}
    for key, its in by_day.items():
        of_lot = (*key[:-2], key[-1])
        parked[of_lot] = parked.get(of_lot, 0) + sum(row["parked"] for row in its)
    days: dict[tuple[Any, ...], list[Row]] = {}
    for key, its in by_day.items():
        cars, amount = sum(row["parked"] for row in its), sum(row["paid"] for row in its)
        days.setdefault(key[:-1], []).append(
            {
                "slots": its[0]["slots"],
                "price": its[0]["price"],
                "occupancy": float(np.nanmean([row["occupancy"] for row in its])),
                "parked_a_day": float(cars),
                "share_parked": cars / max(parked[*key[:-2], key[-1]], 1),
                "paid_a_day": amount,
                "paid_a_car": amount / cars if cars else float("nan"),
            }
        )
    names = (*SETTING_COLUMNS, "zone")
    return [
        dict(zip(names, key, strict=True))
        | {name: its[0][name] for name in ("slots", "price")}
        | day_means(its, MEANS, MEANS)
        for key, its in days.items()
    ]
