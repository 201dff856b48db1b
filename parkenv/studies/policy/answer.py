"""The answer of a policy study: what was reached on held-out days, who wins and loses, and in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.studies.fleet.blocks import ALL, BLOCKS, area_prices
from parkenv.studies.fleet.changes import LEAST_DAYS, is_clear, summarize_changes
from parkenv.studies.fleet.setting import OWN, Setting, middle_of, rate_text
from parkenv.studies.policy.town import share_in_band
from parkenv.studies.results import Results, Row
from parkenv.studies.statistics import columns_of, mean_interval, ratio_interval
from parkenv.world.week import HOUR_S

if TYPE_CHECKING:
    from parkenv.studies.policy.study import HeldOut, PolicyStudy
    from parkenv.world.scenario import Scenario


class Driven(NamedTuple):
    """Held-out days of a policy."""

    setting: Setting  # the policy and the demand
    days: list[Row]
    blocks: list[Row]  # rows of `BLOCKS` of the days


def driven(held_out: HeldOut, results: Results) -> list[Driven]:
    """Return the days of all policies at the demands at which all of them are driven: only these are compared."""
    cells, blocks = held_out.cells(), results.rows(BLOCKS)
    unfinished = {
        cell.work.arrivals_per_hour for cell in cells if len(results.of(held_out, cell)) < len(cell.items)
    }
    return [
        Driven(
            work,
            results.of(held_out, cell),
            [blocks[key] for day in days for key in held_out.keys(work, day)],
        )
        for cell in cells
        for work, days in [cell]
        if work.arrivals_per_hour not in unfinished
    ]


def answer_rows(study: PolicyStudy, held_out: Sequence[Driven], policies: Mapping[str, Row]) -> list[Row]:
    """Return a row for each policy and held-out demand: what of the aims it reaches, with 95 % intervals over days.

    `in_band` is the share of the block-hours whose mean over the days lies in the band, with a jackknife over days;
    `in_band_daily` that of single days.
    """
    rows: list[Row] = []
    today: dict[Any, dict[str, FloatArray]] = {}
    for setting, days, blocks in held_out:
        rate = setting.arrivals_per_hour
        shares = _occupancy(study, blocks)
        names = [study.town.blocks.names[i] for i in study.town.counted]
        shares = shares[:, ~np.isin(names, policies[setting.scenario]["closed"])]
        columns = range(shares.shape[2])
        sums = {
            "cruised_km": np.array([day["cars"] * day["cruised_m"] / 1000.0 for day in days]),
            "time_s": np.array([day["total_s"] - day["parking_cost_s"] for day in days]),
            "revenue": np.array([day["cars"] * day["paid"] for day in days]),
        }
        was = today.setdefault(rate, sums)
        daily = [share_in_band(shares[[k]], columns, study.aims) for k in range(len(days))]
        row = {
            "policy": setting.scenario, "arrivals_per_hour": rate, "days": len(days),
            "cars": sum(day["cars"] for day in days),
            **columns_of("in_band", _jackknife(shares, columns, study)),
            "in_band_daily": float(np.mean(daily)),
            "occupancy": float(shares.mean()),
        }  # fmt: skip
        for name, its in sums.items():
            row |= columns_of(name, mean_interval(its))
            if was[name].sum():
                row |= columns_of(f"{name}_of_today", ratio_interval(its, was[name]))
        rows.append(row | {"balked_fraction": float(np.mean([day["balked_fraction"] for day in days]))})
    return rows


def _occupancy(study: PolicyStudy, days: Sequence[Row]) -> FloatArray:
    """Return the occupancy of the counted blocks in the hours that count, (n_days, n_blocks, n_hours)."""
    names = {study.town.blocks.names[i]: k for k, i in enumerate(study.town.counted)}
    hours = {hour: k for k, hour in enumerate(hour for hour in study.town.hours if hour in study.aims.clock)}
    shares = np.zeros((len(days), len(names), len(hours)))
    for day, row in zip(shares, days, strict=True):
        lines = zip(row["block"], row["purpose"], row["hour"], row["occupancy"], strict=True)
        for block, purpose, hour, share in lines:
            if purpose == ALL and block in names and hour in hours:
                day[names[block], hours[hour]] = share
    return shares


def _jackknife(shares: FloatArray, columns: range, study: PolicyStudy) -> tuple[float, float, float]:
    """Return the share in the band and its interval, from leaving out each day in turn (Tukey 1958)."""
    from scipy.stats import t

    n = len(shares)
    found = share_in_band(shares, columns, study.aims)
    if n < 2:
        return found, np.nan, np.nan
    left = np.array([share_in_band(np.delete(shares, k, axis=0), columns, study.aims) for k in range(n)])
    error = np.sqrt((n - 1) / n * ((left - left.mean()) ** 2).sum()) * t.ppf(0.975, n - 1)
    return found, max(found - float(error), 0.0), min(found + float(error), 1.0)


def loser_rows(held_out: Sequence[Driven], built: Mapping[str, Scenario]) -> list[Row]:
    """Return what changes for the cars of each purpose, and for all, of each policy against today; see `changes`."""
    # Guidance is part of the policy.
    settings = [[{**day, "knows": OWN, "share": 0.0} for day in its.days] for its in held_out]
    prices = {name: area_prices(its) for name, its in built.items()}
    purposes = {
        name: [one.name for one in its.demand.purposes]
        for name, its in built.items()
        if its.demand is not None
    }
    return [row for row in summarize_changes(settings, prices, purposes) if row["zone"] is None]


def block_rows(
    study: PolicyStudy, held_out: Sequence[Driven], rate: float | str, policies: Mapping[str, Row]
) -> list[Row]:
    """Return what each block is today and with our policy, at a held-out demand, in the hours that count."""
    town, shares, cars = study.town, dict[str, FloatArray](), dict[str, float]()
    for setting, _, blocks in held_out:
        if setting.arrivals_per_hour == rate:
            shares[setting.scenario] = _occupancy(study, blocks).mean(axis=(0, 2))
            cars = dict.fromkeys(town.blocks.names, 0.0)  # with the last policy, ours
            for row in blocks:
                for block, purpose, count in zip(row["block"], row["purpose"], row["arrivals"], strict=True):
                    if purpose == ALL and block in cars:
                        cars[block] += count / len(blocks)
    if not shares:
        return []
    rows = []
    for k, i in enumerate(town.counted.tolist()):
        zone, unit = town.blocks.zones[i], town.units[town.unit_of_block[k]]
        table = policies["ours"]["zones"].get(f"{unit[1]}, {zone}" if unit[1] else zone, {})
        spans = [part.split(" @ ") for part in table.get("price", "").split("; ") if part]
        today = town.today[town.unit_of_block[k]]
        rows.append({
            "block": town.blocks.names[i], "zone": zone, "slots": int(town.blocks.slots[i]),
            "cars_a_day": cars[town.blocks.names[i]],
            **{f"taken_{name}": float(share[k]) for name, share in shares.items()},
            "price_today": float(today.mean()),
            "price_ours": float(np.mean([float(a) for a, _ in spans] or today)),
            "prices_ours": ", ".join(f"{hours.replace(':00', '')}: {amount}" for amount, hours in spans),
        })  # fmt: skip
    return rows


def assumed_rows(study: PolicyStudy, held_out: HeldOut) -> list[Row]:
    """Return what was assumed, a row each."""
    scenario = study.town.scenario
    demand = scenario.demand
    purposes = demand.purposes if demand is not None else ()
    names = (
        f"{one.name} (value of an hour: {one.value_of_time or scenario.value_of_time:g})" for one in purposes
    )
    log = "the days of its log say of today" if scenario.occupancy.recorded else "its forecast says of today"
    if study.learns and study.town.has_log:
        log = "earlier days with the same policy were like, by block and hour"
    picked, window = ", ".join(study.levers.choices) or "none", scenario.arrival
    facts = {
        "town": f"{scenario.lot.name}, {int(scenario.lot.capacity.sum()):,} spaces",
        "cars arrive": f"from {window.start_s / HOUR_S:g}:00 to {window.end_s / HOUR_S:g}:00",
        "drivers": f"{study.agent.label}; they know all prices and rules, and expect what {log}",
        "demand of the search": ", ".join(rate_text(rate) for rate in study.arrivals_per_hour),
        "purposes": ", ".join(names),
        "elasticity": "no driver cancels a trip, changes its time or shortens a stay because of a price",
        "prices": f"by {study.levers.by}, multiples of {study.levers.step:g} up to {study.levers.most:g}",
        "other levers": picked,
        "budget": f"{study.budget} days in the search",
        "held out": f"{held_out.days} days each, seed {held_out.seed}: other cars than in the search",
    }
    return [{"assumption": name, "is": text} for name, text in facts.items()]


def headlines(summary: Row) -> list[Row]:
    """Return what a page says in large type."""
    rows = summary.get("answer") or []
    if not rows:
        return []
    rate = middle_of(row["arrivals_per_hour"] for row in rows)
    today, _, ours = (row for row in rows if row["arrivals_per_hour"] == rate)
    low, high = summary["aims"]["band"]
    told = [
        ("in_band", f"of the block-hours {low:.0%} to {high:.0%} full", ".0%", ""),
        ("cruised_km", "cruised a day", ",.0f", " km"),
        ("time_s", "a car, without prices", ",.0f", " s"),
    ]
    if today["revenue"] or ours["revenue"]:
        told.append(("revenue", "paid a day", ",.0f", ""))
    return [
        {
            "label": label,
            "value": f"{ours[name]:{form}}{unit}",
            "interval": f"today {today[name]:{form}}{unit}",
        }
        for name, label, form, unit in told
    ]


def middle_only(summary: Row) -> list[Row]:
    """Return who wins and who loses at the middle demand, in the columns that are shown."""
    if not (losers := summary.get("losers")):
        return []
    rate = middle_of(row["arrivals_per_hour"] for row in summary["answer"])
    rows = [row for row in losers if row["arrivals_per_hour"] == rate]
    shown = (
        "scenario", "purpose", "cars_a_day", "change_s", "change_s_ci95", "paid_change", "better_off", "worse_off",
    )  # fmt: skip
    return [{**{name: row[name] for name in shown}, "purpose": row["purpose"] or "all"} for row in rows]


def sentences(summary: Row) -> list[str]:
    """Return what a council must know, in three sentences, and then what was assumed."""
    rows = summary.get("answer") or []
    if not rows:
        return []
    aims = summary["aims"]
    rate = middle_of(row["arrivals_per_hour"] for row in rows)
    of = {row["policy"]: row for row in rows if row["arrivals_per_hour"] == rate}
    today, rule, ours = of.values()
    low, high = aims["band"]

    def part(row: Row) -> str:
        return f"{row['in_band']:.0%}{_interval(row, 'in_band', '.0%')}"

    def less(row: Row, name: str) -> str:
        change = row[f"{name}_of_today"] - 1.0
        ends = [end - 1.0 for end in row[f"{name}_of_today_ci95"] if end is not None]
        text = (
            " [{:.0%}, {:.0%}]".format(*sorted(map(abs, ends)))
            if len(ends) == 2 and ends[0] * ends[1] > 0.0
            else ""
        )
        return f"{abs(change):.0%} {'less' if change < 0.0 else 'more'}{text}"

    said = [
        f"With this policy {part(ours)} of the block-hours from {aims['hours']} are {low:.0%} to {high:.0%} full, "
        f"with today's prices {part(today)}, with SFpark's rule {part(rule)} ({rate_text(rate)}, held-out days)."
    ]
    if "cruised_km_of_today" in ours:
        money = (
            f", and {ours['revenue']:,.0f} a day is paid, {less(ours, 'revenue')}"
            if "revenue_of_today" in ours
            else ""
        )
        said.append(
            f"Cars cruise {ours['cruised_km']:,.0f} km a day, {less(ours, 'cruised_km')} than today (SFpark's rule: "
            f"{less(rule, 'cruised_km')}); a car takes {ours['time_s']:,.0f} s, today {today['time_s']:,.0f} s{money}."
        )
    changes = [
        row
        for row in summary["losers"]
        if row["scenario"] == ours["policy"] and row["arrivals_per_hour"] == rate
    ]
    losers = sorted((row for row in changes if row["purpose"]), key=lambda row: row["change_s"])
    if losers:
        worst, best = losers[-1], losers[0]
        said.append(
            f"Prices counted as time, {_who(best)}, {_who(worst)}: "
            f"{best['better_off']:.0%} and {worst['better_off']:.0%} of them are better off, "
            f"{best['worse_off']:.0%} and {worst['worse_off']:.0%} worse off."
        )
    return [*said, *_other_demands(rows, rate, aims), _missed(ours, aims, losers or changes)]


def _who(row: Row) -> str:
    verb = "gain" if row["change_s"] < 0.0 else "lose"
    text = f"{row['purpose']} {verb} {abs(row['change_s']):.0f} s a car"
    return text if is_clear(row, "change_s") or row["days"] < LEAST_DAYS else f"{text} (no clear difference)"


def _other_demands(rows: Sequence[Row], rate: Any, aims: Row) -> list[str]:
    others = [row for row in rows if row["arrivals_per_hour"] != rate and row["policy"] == "ours"]
    if not others:
        return []
    parts = [f"{row['in_band']:.0%} at {rate_text(row['arrivals_per_hour'])}" for row in others]
    band = f"{aims['band'][0]:.0%} to {aims['band'][1]:.0%}"
    return [
        f"Where demand differs from what the policy was made for, in the band of {band}: {', '.join(parts)}."
    ]


def _missed(ours: Row, aims: Row, losers: Sequence[Row]) -> str:
    missed = []
    if aims.get("in_band") and ours["in_band"] < aims["in_band"]:
        missed.append(f"{aims['in_band']:.0%} of the block-hours in the band, {ours['in_band']:.0%} reached")
    for name, aim, words in (
        ("cruised_km", "cruised", "of today's kilometres cruised"),
        ("time_s", "time", "of today's time"),
    ):
        its = ours.get(f"{name}_of_today")
        if aims.get(aim) is not None and its is not None and its > aims[aim]:
            missed.append(f"at most {aims[aim]:.0%} {words}, {its:.0%} reached")
    if aims.get("revenue") is not None and ours.get("revenue_of_today", 1.0) < aims["revenue"]:
        missed.append(f"{aims['revenue']:.0%} of today's revenue, {ours['revenue_of_today']:.0%} reached")
    worst_s = max((row["change_s"] for row in losers), default=0.0)
    if aims.get("loss_s") is not None and worst_s > aims["loss_s"]:
        missed.append(f"at most {aims['loss_s']:g} s lost by a car of any purpose, {worst_s:.0f} s lost")
    return f"Missed: {'; '.join(missed)}." if missed else "All aims are reached."


def _interval(row: Row, name: str, form: str) -> str:
    low, high = row[f"{name}_ci95"]
    known = None not in (low, high) and low == low
    return f" [{low:{form}}, {high:{form}}]" if known else ""
