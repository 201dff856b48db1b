"""What changes for whom: the same cars on the same days in another scenario, or with other guidance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from parkenv.show.plurals import interval_text, number_text, plural
from parkenv.studies.fleet.setting import CAR_LISTS, COUNTED, GIVEN, NOWHERE, OWN, SETTING_COLUMNS, rate_text
from parkenv.studies.fleet.tables import day_means, paired_days
from parkenv.studies.results import Row
from parkenv.studies.statistics import mean_or_nan

NOTICED_S = 1.0
"""A car is better or worse off if its total time differs by at least this, s."""
LEAST_DAYS = 5
"""Days below which nothing is called better or worse: with fewer, a bootstrap interval covers less than 95 %."""
_ZONES_TOLD = 8  # those in which the most cars parked before
_NAMED = 3  # zones whose prices change alike, above which they are counted
_SHOWN_S = 0.05  # a part of a change that is said
CHANGES = (
    "change_s", "members_change_s", "others_change_s", "search_change_s", "parking_cost_change_s", "gave_up_change_s",
    "balked_change", "paid_change", "better_off", "worse_off",
)  # fmt: skip
"""Columns of a change: each has a 95 % interval over the days of both."""
GUIDANCE = {
    OWN: "own observations", "shared": "a live map", "reserve": "reservations", "full": "full knowledge",
}  # fmt: skip
"""What members know, in sentences."""


def summarize_changes(
    settings: Sequence[list[Row]],
    prices: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
    purposes: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> list[Row]:
    """Return a row for each change between two settings, from the days of each setting, at least one.

    A scenario is compared with the first one, and guidance with nobody knowing more than what it observes; everything
    else is equal. Days are paired, and on each of them the cars: members, and others, are the same cars before and
    after. Differences are those after minus those before, so that negative times are gains. Where a lot has several
    zones, further rows are about the cars that parked in each `zone` before, and about those that found no slot, if
    there are some on each day: those who park gain less than the others by any change, as they had luck before. Of
    several purposes, further rows are about the cars of each `purpose`. Both are None for all cars.

    Args:
        settings: the days of each setting.
        prices: of each scenario, the price of an hour in each zone of the lot, in the order of the zones.
        purposes: of each scenario, those of its own demand, in their order, where there are several.
    """
    settings = [[_with_lists(day) for day in days] for days in settings]
    by_setting = {tuple(days[0][name] for name in SETTING_COLUMNS): days for days in settings}
    first = settings[0][0]["scenario"] if settings else ""
    rows = []
    for days in settings:
        its = {name: days[0][name] for name in SETTING_COLUMNS}
        for what, before in (("scenario", {"scenario": first}), ("knows", {"knows": OWN, "share": 0.0})):
            earlier = by_setting.get(tuple((its | before)[name] for name in SETTING_COLUMNS), [])
            rate = its["arrivals_per_hour"]
            follows = isinstance(rate, str) and rate != GIVEN and not purposes.get(str(its["scenario"]))
            if what == "scenario" and (follows or rate == COUNTED):
                continue  # a demand that follows counts has its own cars in every scenario
            if its[what] != before[what] and (pairs := paired_days(days, earlier)):
                names = _words(what, its | before), _words(what, its)
                head = {"change": what, "before": names[0], "after": names[1], **its, "days": len(pairs)}
                old, new = (prices.get(str(one["scenario"]), {}) for one in (its | before, its))
                head["prices"] = _new_prices(old, new)
                zones = enumerate((NOWHERE, *old)) if len(old) > 1 else ()
                mixed = all(len(day["purpose"]) for day in pairs[0])
                named = enumerate(purposes.get(str((its | before)["scenario"]), ())) if mixed else ()
                parts = [
                    ("", None, None),
                    *(("zone", *one) for one in zones),
                    *(("purpose", *one) for one in named),
                ]
                for column, number, name in parts:
                    changes = [_change(*pair, column, number) for pair in pairs]
                    if name != NOWHERE or all(change["cars_a_day"] for change in changes):
                        part = {"zone": None, "purpose": None} | ({column: name} if column else {})
                        rows.append(head | part | day_means(changes, ("cars_a_day", *CHANGES), CHANGES))
    return sorted(rows, key=lambda row: row["change"] != "scenario")


def _words(what: str, setting: Row) -> str:
    """Return what is compared of a setting.

    Examples:
        >>> _words("knows", {"knows": "reserve", "share": 0.25}), _words("knows", {"knows": "own", "share": 0.0})
        ('reservations for 25 %', 'own observations')
    """
    if what == "scenario" or setting["knows"] == OWN:
        return str(setting["scenario"] if what == "scenario" else GUIDANCE[OWN])
    members = "all" if setting["share"] == 1.0 else f"{100.0 * setting['share']:g} %"
    return f"{GUIDANCE[setting['knows']]} for {members}"


def _new_prices(before: Mapping[str, float], after: Mapping[str, float]) -> str | None:
    """Return the prices that change, in words; None if none does.

    Examples:
        >>> _new_prices({"centre": 0.0, "ring": 0.5}, {"centre": 2.0, "ring": 0.5})
        'centre 0 → 2 an hour'
    """
    new: dict[str, list[str]] = {}
    for zone, price in after.items():
        if before.get(zone, price) != price:
            new.setdefault(f"{before[zone]:g} → {price:g}", []).append(zone)
    said = []
    for prices, zones in new.items():
        named = zones if len(zones) <= _NAMED else [zones[0], f"{len(zones) - 1} zones more"]
        said.append(f"{', '.join(named)} {prices}")
    return f"{', '.join(said)} an hour" if said else None


def _change(after: Row, before: Row, column: str, number: int | None) -> Row:
    """Return what changes on a day, with its lists, for some cars; NaN where it is not known.

    They are those that have a number in a column of `CAR_LISTS` before: that parked in a `zone`, or are of a `purpose`.
    None is for all cars.
    """
    row = dict.fromkeys(("cars_a_day", *CHANGES), float("nan"))
    if number is None:
        row |= {
            "cars_a_day": after["cars"],
            "change_s": after["total_s"] - before["total_s"],
            "search_change_s": after["search_s"] - before["search_s"],
            "parking_cost_change_s": after["parking_cost_s"] - before["parking_cost_s"],
            "gave_up_change_s": after["gave_up_s"] - before["gave_up_s"],
            "balked_change": after["balked_fraction"] - before["balked_fraction"],
        }
    times, earlier, member = after["total_cs"], before["total_cs"], after["member"]
    if not len(times) == len(earlier) == len(member) > 0:
        return row
    its = np.ones(len(times), bool) if number is None else before[column] == number
    gained = (times - earlier) / 100.0
    cents, earlier_cents = after["paid_cents"], before["paid_cents"]
    if len(cents) or len(earlier_cents):
        free = np.zeros(len(times))  # in a lot without prices
        cents, earlier_cents = (known if len(known) else free for known in (cents, earlier_cents))
        row["paid_change"] = mean_or_nan((cents - earlier_cents)[its] / 100.0)
    if number is not None:
        row |= {"cars_a_day": float(its.sum()), "change_s": mean_or_nan(gained[its])}
    return row | {
        "members_change_s": mean_or_nan(gained[its & (member == 1.0)]),
        "others_change_s": mean_or_nan(gained[its & (member == 0.0)]),
        "better_off": mean_or_nan((gained <= -NOTICED_S)[its]),
        "worse_off": mean_or_nan((gained >= NOTICED_S)[its]),
    }


def _with_lists(day: Row) -> Row:
    """Return a day with `CAR_LISTS` as arrays, (n_cars,) float64, empty where they are not known."""
    return {**day, **{name: np.array(day.get(name, "").split(), np.float64) for name in CAR_LISTS}}


# ---- in words


def sentence(row: Row) -> str:
    """Return a change in a sentence; it calls no mean a gain or a loss whose interval includes 0."""
    said = [_gain(row, "change_s", "a car saves", "a car loses", "a car")]
    minutes = abs(row["change_s"]) * row["cars_a_day"] / 60.0
    if is_clear(row, "change_s") and minutes >= 1.0:
        said[0] += f", all cars of a day together {minutes:,.0f} min"
    if parts := made_of(row):
        said[0] += f": {parts}"
    elif is_known(row["paid_change"]):
        said[0] += " with prices as time"
    if is_known(row["members_change_s"]) and is_known(row["others_change_s"]):
        said.append(_gain(row, "members_change_s", "members save", "members lose", "members"))
        said.append(_gain(row, "others_change_s", "the others save", "the others lose", "the others"))
    if is_known(row["better_off"]):
        gain, lose = row["better_off"], row["worse_off"]  # each car compared with itself, whatever the mean
        said.append(f"{gain:.0%} of the cars are better off by {NOTICED_S:g} s or more, {lose:.0%} worse off")
    if is_clear(row, "paid_change"):
        way = "less" if row["paid_change"] < 0.0 else "more"
        low, high = sorted(map(abs, row["paid_change_ci95"]))
        said.append(f"a car pays {abs(row['paid_change']):.2f} {way} [{low:.2f}, {high:.2f}]")
    if is_clear(row, "balked_change"):
        way = "falls" if row["balked_change"] < 0.0 else "rises"
        said.append(
            f"the share that finds no slot {way} by {100.0 * abs(row['balked_change']):.1f} percentage points"
        )
    after = row["after"] if row["change"] == "scenario" else row["after"][0].upper() + row["after"][1:]
    return f"{after} instead of {row['before']} ({', '.join(where(row))}): {'; '.join(said)}."


def made_of(row: Row) -> str:
    """Return how much of a change of the total time is time, how much prices, and how much give-up penalties.

    Empty if it is time alone, or if the parts are not known.
    """
    cost_s, gave_up_s = row["parking_cost_change_s"], row["gave_up_change_s"]
    if not is_known(cost_s) or max(abs(cost_s), abs(gave_up_s)) < _SHOWN_S:
        return ""
    time_s = row["change_s"] - cost_s - gave_up_s
    parts = [f"{abs(time_s):.1f} s {'longer' if time_s > 0.0 else 'shorter'}"]
    ways = ["more" if part > 0.0 else "less" for part in (cost_s, gave_up_s)]
    if abs(cost_s) >= _SHOWN_S:
        paid = row["paid_change"]
        amount = f"{abs(paid):.2f} {ways[0]} paid" if is_known(paid) else f"{ways[0]} cost of parking"
        parts.append(f"{amount} ({cost_s:+.1f} s as time)")
    if abs(gave_up_s) >= _SHOWN_S:
        penalty = f"{abs(gave_up_s):.1f} s {ways[1]} give-up penalty"
        parts.append(f"{penalty} ({row['balked_change']:+.2%} find no slot)")
    return ", ".join(parts)


def where(row: Row) -> list[str]:
    """Return the prices that change, and what is equal before and after a change, in words."""
    if row["change"] == "knows":
        return place(row)
    equal = [row["prices"]] if row["prices"] and not of_part(row) else []  # said once, of all cars
    equal += [row["agents"], rate_text(row["arrivals_per_hour"])]
    equal += [] if row["knows"] == OWN else [_words("knows", row)]
    if row["purpose"]:
        return [*equal, str(row["purpose"])]
    if not row["zone"]:
        return equal
    found = "found no slot" if row["zone"] == NOWHERE else f"parked in zone {row['zone']}"
    return [*equal, f"cars that {found} before"]


def of_part(row: Row) -> bool:
    """Return whether a change is about the cars of a zone or of a purpose, not about all."""
    return bool(row["zone"] or row["purpose"])


def place(row: Row) -> list[str]:
    """Return who drives where, and the demand, in words."""
    return [f"{row['agents']} on {row['scenario']}", rate_text(row["arrivals_per_hour"])]


def is_clear(row: Row, name: str) -> bool:
    """Return whether a column has an interval of enough days, and it does not include 0."""
    low, high = interval_of(row, name) or (0.0, 0.0)
    return row["days"] >= LEAST_DAYS and low * high > 0.0


def _gain(row: Row, name: str, saves: str, loses: str, who: str) -> str:
    value, ends = row[name], interval_of(row, name)
    if is_clear(row, name):
        low, high = sorted(map(abs, ends or ()))
        return f"{saves if value < 0.0 else loses} {abs(value):.1f} s [{low:.1f}, {high:.1f}]"
    if ends == (0.0, 0.0):
        return f"{who}: no difference"
    number, _, interval = interval_text(value, ends, "+.1f").partition(" ")
    shown = f"{number} s {interval}".rstrip()
    if row["days"] < LEAST_DAYS:
        return f"{who}: {shown} on {plural(row['days'], 'day')}, too few to tell"
    return f"{who}: no clear difference on average, {shown}"


def is_known(value: float | None) -> bool:
    """Return whether there is a number."""
    return value is not None and value == value


def interval_of(row: Row, name: str) -> tuple[float, float] | None:
    """Return the 95 % interval of a column, None where there is none."""
    low, high = row.get(f"{name}_ci95", (None, None))
    return (low, high) if is_known(low) and is_known(high) else None


def headlines(rows: Sequence[Row], changes: Sequence[Row], most: int = 4) -> list[Row]:
    """Return what a page says in large type: the changes of all cars, or else their total times.

    Each has a `label`, a `value` in words, and for a change the shares `better` and `worse`, if they are known.
    """
    if not (chosen := [row for row in shown_changes(changes) if not of_part(row)]):
        totals = [
            {"label": ", ".join(place(row)), "value": f"{row['total_s']:.1f} s a car"} for row in rows[:most]
        ]
        if len(rows) != 1:
            return totals
        (row,) = rows
        told = {
            "from the entry to a space, or to giving up": f"{row['search_s'] / 60.0:.1f} min",
            "of the cars find no slot": f"{row['balked_fraction']:.1%}",
            "of all metres are cruised": f"{row['cruising_share']:.0%}",
        }
        return [*totals, *({"label": label, "value": value} for label, value in told.items())]
    made = []
    for row in chosen[:most]:
        value = "no clear difference on average" if row["days"] >= LEAST_DAYS else "too few days to tell"
        interval, ends = "no interval", interval_of(row, "change_s")
        if ends:
            interval = "95 % interval {} to {} s".format(*(number_text(end, "+.1f") for end in ends))
        if is_clear(row, "change_s"):
            value = f"{abs(row['change_s']):.1f} s {'less' if row['change_s'] < 0.0 else 'more'} a car"
            interval = "95 % interval {:.1f} to {:.1f} s".format(*sorted(map(abs, ends or ())))
        if parts := made_of(row):
            interval = f"{parts}; {interval}"
        one = {"label": f"{row['after']} instead of {row['before']}", "where": ", ".join(where(row))}
        off = {"better": row["better_off"], "worse": row["worse_off"]} if is_known(row["better_off"]) else {}
        made.append(one | {"value": value, "interval": interval} | off)
    return made


def shown_changes(changes: Sequence[Row]) -> list[Row]:
    """Return the known changes that are told: without members or with as many as there are, one guidance by demand."""
    most = max((row["share"] for row in changes), default=0.0)
    told = [
        row for row in changes
        if row["change"] == "scenario" and is_known(row["change_s"]) and row["share"] in (0.0, most)
        and not (of_part(row) and row["share"])
    ]  # fmt: skip
    busiest = sorted((row["cars_a_day"] for row in told if row["zone"]), reverse=True)[:_ZONES_TOLD]
    told = [row for row in told if not row["zone"] or row["cars_a_day"] >= busiest[-1]]
    of_guidance: dict[tuple[Any, ...], list[Row]] = {}
    for row in changes:
        if row["change"] == "knows" and not of_part(row):
            key = row["scenario"], row["agents"], row["arrivals_per_hour"]
            of_guidance.setdefault(key, []).append(row)
    # A choice by the result would be a winner of chance.
    guided = [
        max(its, key=lambda row: (row["share"], row["knows"] == "reserve")) for its in of_guidance.values()
    ]
    return sorted(told, key=lambda row: row["knows"] != OWN) + guided
