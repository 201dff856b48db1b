"""What policies are in a town, what a day with one tells, and how far it is from the aims."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.engine.fleet import Fleet
from parkenv.errors import InputError, naming, nearest
from parkenv.scenarios.build import named, with_zones
from parkenv.scenarios.spec import ZoneSpec
from parkenv.studies.fleet.blocks import Blocks, paid
from parkenv.studies.fleet.measures import Roads
from parkenv.studies.policy.spec import Aims, Levers, clock_hours
from parkenv.studies.results import Row
from parkenv.world.occupancy.recorded import RecordedOccupancy
from parkenv.world.scenario import Scenario
from parkenv.world.tariff import PUBLIC
from parkenv.world.week import DAY_HOURS, DAY_PERIODS, DAY_S, HOUR_S

LOOK_S = 300.0
"""Time between two looks at the slots, s."""
CLOSED = "off"


class Policy(NamedTuple):
    """What a town does.

    Attributes:
        prices: (n_units, n_bands) prices of an hour, before they are rounded to what is posted; None: today's.
        picks: chosen alternative of each of `Levers.choices`.
        expects: (n_blocks, n_hours) what drivers expect: the share of a block's slots that is taken, and how often a
            counted facility is full, in the hours in which cars arrive; None: what the scenario says.
    """

    prices: FloatArray | None = None
    picks: tuple[int, ...] = ()
    expects: FloatArray | None = None

    def learned(self, days: Sequence[Row], weight: float) -> Policy:
        """Return this policy with drivers who know further days of it, rows of `PolicyTown.day`.

        Args:
            days: the days.
            weight: of these days, beside what was expected before.
        """
        taken = np.mean([day["taken"] for day in days], axis=0)
        before = taken if self.expects is None else self.expects
        return self._replace(expects=(1.0 - weight) * before + weight * taken)


def expecting(scenario: Scenario, blocks: Blocks, expects: FloatArray | None) -> Scenario:
    """Return a scenario that has a log with drivers who expect what `Policy` says of the blocks."""
    if expects is None:
        return scenario
    taken, periods = np.full((scenario.lot.n_slots, DAY_PERIODS), np.nan), DAY_PERIODS // DAY_HOURS
    hours = clock_hours(scenario.arrival)
    taken[:, hours.start * periods : hours.stop * periods] = np.repeat(expects, periods, axis=1)[
        blocks.of_slot
    ]
    return scenario.replace(occupancy=replace(cast(RecordedOccupancy, scenario.occupancy), expected=taken))


class PolicyTown:
    """A town whose levers are moved.

    Args:
        scenario: the town as it is today.
        levers: what may change.
        aims: what is wanted.

    Attributes:
        units: zone and facility (empty: all) of each price.
        today: (n_units, n_bands) what an hour costs today in the middle of each band.
        is_counted: (n_blocks,) bool, which blocks are counted facilities.
        counted: the blocks that count, as indices into `blocks`.
        fleet: that of the policy that was driven last, for its next day.

    Raises:
        InputError: a lever names what the town does not have.
    """

    def __init__(self, scenario: Scenario, levers: Levers, aims: Aims) -> None:
        self.scenario, self.levers, self.aims = scenario, levers, aims
        self.blocks = Blocks.of(scenario.lot)
        self.is_counted = np.zeros(len(self.blocks.names), bool)
        self.is_counted[self.blocks.of_slot[scenario.lot.is_counted]] = True
        self.fleet: tuple[Any, Any] | None = None
        lot, rules = scenario.lot, {zone.name: zone for zone in scenario.zone_rules}
        for name in (*levers.max_stay_s, *levers.users):
            if name not in rules:
                raise InputError(
                    f"levers: lot {lot.name!r:.40} has no zone {name!r:.40}; {nearest(name, rules)}"
                )
        for name, rule in rules.items():
            for field, its in {"max_stay_s": rule.max_stay_s or 0.0, "users": rule.users}.items():
                if (first := next(iter(getattr(levers, field).get(name, ())), its)) != its:
                    raise InputError(
                        f"levers.{field}.{name} begins with {first}, want what is so today, {its}, first"
                    )
        if levers.step > levers.most:
            raise InputError(f"levers.step is {levers.step:g}, want at most levers.most, {levers.most:g}")
        facilities = [facility.name for facility in lot.facilities]
        for name in levers.open:
            if name not in facilities:
                raise InputError(f"levers: the lot has no facility {name!r:.40}; {nearest(name, facilities)}")
        with naming("levers.zones"):
            zones = tuple(list(rules)[k] for k in sorted(set(named(levers.zones, list(rules)))))
        zones = zones or tuple(name for name, zone in rules.items() if zone.price and PUBLIC in zone.users)
        if not zones:
            raise InputError("levers.zones is missing: no zone has a price today, want the names of some")
        self.counted = np.flatnonzero(np.isin(self.blocks.zones, zones))
        self.facility = [
            "" if k < 0 else lot.facilities[k].name
            for k in (lot.facility_of_slot[np.flatnonzero(self.blocks.of_slot == i)[0]] for i in self.counted)
        ]
        its = [self.blocks.zones[i] for i in self.counted]
        by_block = levers.by == "block" and all(self.facility)
        self.units = (
            list(zip(its, self.facility, strict=True)) if by_block else [(zone, "") for zone in zones]
        )
        unit = {one: k for k, one in enumerate(self.units)}
        self.unit_of_block = np.array(
            [unit[zone, name if by_block else ""] for zone, name in zip(its, self.facility, strict=True)]
        )
        middle = [float(np.mean(band)) * HOUR_S + HOUR_S / 2 for band in levers.bands]
        weekday = scenario.arrival.weekdays[0] * DAY_S
        self.today = np.array(
            [[float(rules[zone].price.amount(weekday + s, HOUR_S)) for s in middle] for zone, _ in self.units]
        )

    @property
    def has_log(self) -> bool:
        """Whether drivers expect what the days of a log were like."""
        return self.scenario.prior is None and isinstance(self.scenario.occupancy, RecordedOccupancy)

    def posted(self, prices: FloatArray) -> FloatArray:
        """Return prices as they are posted: in steps, from 0 to the highest."""
        step = self.levers.step
        return np.round(
            np.clip(np.round(prices / step), 0, np.floor(self.levers.most / step + 1e-9)) * step, 6
        )

    def picked(self, policy: Policy) -> dict[str, Any]:
        """Return the chosen alternative of each lever but prices."""
        picks = policy.picks or (0,) * len(self.levers.choices)
        return {name: its[k] for (name, its), k in zip(self.levers.choices.items(), picks, strict=True)}

    def guided(self, policy: Policy) -> float:
        """Return the share of the drivers who are guided."""
        return float(self.picked(policy).get("guided", 0.0))

    def tables(self, policy: Policy) -> dict[str, dict[str, Any]]:
        """Return the table `zones` of the scenario with a policy."""
        tables: dict[str, dict[str, Any]] = {}
        if policy.prices is not None:
            for (zone, name), row in zip(self.units, self.posted(policy.prices).tolist(), strict=True):
                spans = zip(row, self.levers.hours, strict=True)
                text = "; ".join(f"{price:.12g} @ {hours}" for price, hours in spans)
                cut = {"of": zone, "facilities": [name]} if name else {}
                tables[f"{name}, {zone}" if name else zone] = cut | {"price": text}
        lot, blocks = self.scenario.lot, self.blocks
        for lever, value in self.picked(policy).items():
            kind, _, name = lever.partition(".")
            if kind in ("max_stay_s", "users"):
                if value != self.levers.choices[lever][0]:
                    # What is cut out of a zone has its rules, too: the zone comes first.
                    tables = {name: tables.pop(name, {}) | {kind: value}} | tables
            elif kind == "open" and value != self.levers.choices[lever][0]:
                facility = next(k for k, one in enumerate(lot.facilities) if one.name == name)
                for zone in sorted(
                    {blocks.zones[b] for b in blocks.of_slot[lot.facility_of_slot == facility]}
                ):
                    cut = {"of": zone, "facilities": [name]}
                    tables.setdefault(f"{name}, {zone}", cut)["hours"] = value
        return tables

    def with_policy(self, policy: Policy) -> Scenario:
        """Return the scenario with a policy."""
        tables = self.tables(policy)
        specs = {name: ZoneSpec.parse(table, f"zones.{name}") for name, table in tables.items()}
        changed = self.scenario.replace(lot=with_zones(self.scenario.lot, specs))
        return expecting(changed, self.blocks, policy.expects)

    def is_open(self, policy: Policy) -> BoolArray:
        """Return which of the counted blocks are open with a policy, (n,) bool."""
        picked = self.picked(policy)
        return np.array([picked.get(f"open.{name}") != CLOSED for name in self.facility], bool)

    @cached_property
    def roads(self) -> Roads:
        """Shortest drives: the same with every policy."""
        return Roads(self.scenario)

    @cached_property
    def hours(self) -> range:
        """Hours of the day in which cars arrive."""
        return clock_hours(self.scenario.arrival)

    def day(self, fleet: Fleet, agents: Sequence[Any]) -> Row:
        """Drive the day of a fleet that has been reset; return what it tells."""
        midnight, looks = fleet.begin // DAY_S * DAY_S, []
        for time in self._times():
            fleet.run(agents, until=max(midnight + time, fleet.begin))
            looks.append(np.bincount(self.blocks.of_slot, fleet.counts(), len(self.blocks.names)))
        fleet.run(agents)
        every = np.array(looks) / self.blocks.slots
        # What drivers expect of a counted facility is whether it is full.
        taken = np.where(self.is_counted, every >= 1.0, every)
        arrives = fleet.cars["parked_at"] < 0
        cars = fleet.cars[arrives]
        purposes = [cars["total_s"][cars["purpose"] == k] for k in range(len(fleet.demand.purposes))]
        return {
            "cars": len(cars),
            "occupancy": self._by_hour(every[:, self.counted], 5),
            "taken": self._by_hour(taken, 3),
            "cruised_km": float(self.roads.cruised_m(cars).sum()) / 1000.0,
            "time_s": float((cars["total_s"] - cars["parking_cost_s"]).mean()),
            "revenue": float(paid(fleet)[arrives].sum()),
            "purpose_s": [float(its.mean()) if len(its) else 0.0 for its in purposes],
        }

    def _by_hour(self, looks: FloatArray, digits: int) -> list[list[float]]:
        """Return means over the hours, (n_blocks, n_hours), of what looks found, (n_looks, n_blocks)."""
        hourly = looks.reshape(len(self.hours), -1, looks.shape[1]).mean(axis=1)
        return [[round(share, digits) for share in its] for its in hourly.T.tolist()]

    def _times(self) -> Iterator[float]:
        for hour in self.hours:
            yield from hour * HOUR_S + np.arange(0.0, HOUR_S, LOOK_S)

    def measures(self, days: Sequence[Row], open_blocks: BoolArray, today: Sequence[Row]) -> Row:
        """Return what days of a policy tell beside days of today: `in_band`, and what of today's there is.

        Args:
            days: rows of `day`.
            open_blocks: of `is_open`.
            today: rows of `day`, as it is today.
        """
        if not days:
            return {}
        mean = {
            name: float(np.mean([day[name] for day in days])) for name in ("cruised_km", "time_s", "revenue")
        }
        was = {name: float(np.mean([day[name] for day in today])) for name in mean}
        change = np.mean([day["purpose_s"] for day in days], axis=0)
        change = change - np.mean([day["purpose_s"] for day in today], axis=0)
        return {
            "in_band": share_in_band(
                np.array([day["occupancy"] for day in days])[:, open_blocks], self.columns, self.aims
            ),
            **{name: mean[name] / was[name] if was[name] else 1.0 for name in mean},
            "loss_s": float(change.max()),
        }

    @cached_property
    def columns(self) -> list[int]:
        """Columns of `occupancy` of the hours that count."""
        columns = [k for k, hour in enumerate(self.hours) if hour in self.aims.clock]
        if not columns:
            raise InputError(
                f"aims.hours is {self.aims.hours}, want hours in which cars arrive "
                f"({self.hours.start}:00-{self.hours.stop}:00)"
            )
        return columns

    def lacks(self, measures: Mapping[str, float]) -> dict[str, float]:
        """Return by how much each aim is missed, as a share; below 0: it is more than reached."""
        aims, lacks = self.aims, {}
        if aims.in_band:
            lacks["in_band"] = aims.in_band - measures["in_band"]
        if aims.cruised is not None:
            lacks["cruised"] = measures["cruised_km"] - aims.cruised
        if aims.time is not None:
            lacks["time"] = measures["time_s"] - aims.time
        if aims.revenue is not None:
            lacks["revenue"] = aims.revenue - measures["revenue"]
        if aims.loss_s is not None:
            lacks["loss"] = (measures["loss_s"] - aims.loss_s) / 60.0
        return lacks


def share_in_band(occupancy: FloatArray, columns: Sequence[int], aims: Aims) -> float:
    """Return the share of the block-hours whose mean over days lies in the band; 0 where no block is open.

    Args:
        occupancy: (n_days, n_blocks, n_hours).
        columns: the hours that count.
        aims: the band.
    """
    mean = occupancy[:, :, list(columns)].mean(axis=0)
    return float(((mean >= aims.band[0]) & (mean <= aims.band[1])).sum() / max(mean.size, 1))
