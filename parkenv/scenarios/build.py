"""Build scenarios from their specifications."""

from __future__ import annotations

import dataclasses
import inspect
import warnings
from collections.abc import Iterable, Mapping, Sequence
from datetime import date, timedelta
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from parkenv.compiled.arrays import IntArray
from parkenv.errors import InputError, naming, nearest, require, require_keywords
from parkenv.files.known_names import SAME_SLOTS
from parkenv.files.option import parse_call
from parkenv.files.user_class import load_class
from parkenv.forecast.count_table import listed_faults
from parkenv.lots import city_lot, grid_lot, packaged_lot, read_lot
from parkenv.scenarios.spec import (
    CountsSpec,
    ForecastSpec,
    LotSpec,
    OccupancySpec,
    PurposeSpec,
    ScenarioSpec,
    SensorModelSpec,
    TypicalWeek,
    ZoneSpec,
    scenario_specs,
)
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.process import ConstantForecast, OccupancyModel, OccupancyProcess, PriorModel
from parkenv.world.occupancy.typical_week import (
    attraction,
    real_week_occupancy,
    typical_occupancy,
    with_event,
    with_full_facilities,
)
from parkenv.world.scenario import KMH, Scenario
from parkenv.world.sensor_model import SensorModel
from parkenv.world.tariff import PUBLIC, Tariff, Zone
from parkenv.world.traffic import Traffic
from parkenv.world.week import DAY_S

if TYPE_CHECKING:
    from parkenv.forecast.counts import Counts
    from parkenv.forecast.day_forecast import DayForecast
    from parkenv.world.demand import TownDemand
    from parkenv.world.occupancy.arrival_window import ArrivalWindow
    from parkenv.world.occupancy.log import OccupancyLog, RecordedFile

# Default driving speeds: in a car park (the thesis's), and in a town, whose junctions are part of the mean.
LOT_KMH, TOWN_KMH = 10.0, 20.0
MIN_PAST_DAYS = 2  # days of counts that a forecast needs at least
ScenarioSource = str | Path | Mapping[str, Any] | ScenarioSpec | ParkingLot | Scenario
ScenarioSources = ScenarioSource | Sequence[ScenarioSource]


def make_scenario(source: ScenarioSource, **changes: Any) -> Scenario:
    """Make one scenario; see `make_scenarios`.

    Raises:
        InputError: see `make_scenarios`; or the source has more than one scenario.

    Examples:
        >>> scenario = make_scenario("campus", failure_s=90.0)
        >>> scenario.lot.name, scenario.failure_s
        ('campus', 90.0)
    """
    scenarios = make_scenarios(source, **changes)
    if len(scenarios) > 1:
        raise InputError(f"scenario has {len(scenarios)} scenarios, want one")
    return scenarios[0]


def make_scenarios(source: ScenarioSources, **changes: Any) -> list[Scenario]:
    """Make the scenarios that `scenario=` of an environment, or `--scenario`, stands for.

    Args:
        source: name of a packaged scenario, such as campus; a scenario file (.toml); a lot file
            (.geojson, .yml), which has a week and days as in busy real car parks; a folder of scenario and
            lot files; the tables of a scenario file; a `ScenarioSpec`; a `ParkingLot` (with a typical week, and days as
            forecast); a `Scenario`; or a sequence of these.
        changes: fields of `Scenario` to replace in all of them, and `day_error`, how far whole days differ from the
            forecast (a `DayError`, or a number, its level): 0 for days that are as forecast.

    Raises:
        InputError: an unknown scenario, an invalid value or file; the message is one line.
        TypeError: an unknown field.

    Examples:
        >>> [scenario.name for scenario in make_scenarios(["campus", "mini"])]
        ['campus', 'mini']
    """
    if "day_error" in changes:
        day_error = changes.pop("day_error")
        return [_with_day_error(scenario, day_error) for scenario in make_scenarios(source, **changes)]
    if isinstance(source, Scenario):
        return [source.replace(**changes)]
    if isinstance(source, ParkingLot):
        return [_of_lot(source, changes)]
    if isinstance(source, Mapping):
        source = ScenarioSpec.parse(source, "scenario")
    if isinstance(source, ScenarioSpec):
        return [build(source).replace(**changes)]
    if isinstance(source, str | Path):
        return [build(spec).replace(**changes) for spec in scenario_specs(source)]
    if not isinstance(source, Sequence):
        raise InputError(
            f"scenario is a {type(source).__name__}, want a Scenario, its name, file or tables, a ScenarioSpec, a "
            "ParkingLot, or a sequence of these"
        )
    if not source:
        raise InputError("scenario is an empty sequence, want at least one scenario")
    return [scenario for each in source for scenario in make_scenarios(each, **changes)]


def require_changes(owners: Sequence[type], changes: Iterable[str], *others: str) -> None:
    """Raise TypeError for keywords that are no argument of the owners, field of the scenario, or one of the others."""
    own = [
        name
        for owner in owners
        for name in inspect.signature(owner).parameters
        if name not in ("changes", "options")
    ]
    fields = [field.name for field in dataclasses.fields(Scenario)]
    require_keywords(
        owners[0].__name__, changes, dict.fromkeys((*sorted(own), *others, *fields, "day_error"))
    )


def _of_lot(lot: ParkingLot, changes: dict[str, Any]) -> Scenario:
    goal = changes.get("goal", 0)
    occupancy = changes.get("occupancy") or with_full_facilities(typical_occupancy(lot, goal=goal), lot)
    scenario = Scenario(name=lot.name, lot=lot, goal=goal, occupancy=occupancy)
    return scenario.replace(**changes | {"occupancy": occupancy})


def build(spec: ScenarioSpec) -> Scenario:
    """Make the world of a specification: its lot, occupancy, forecast, sensor model, costs and demand."""
    try:
        lot, goal = _lot(spec.lot), spec.goal
        if isinstance(goal, tuple):
            lot, goal = dataclasses.replace(lot, goals=np.array([goal]), goal_weights={}), 0
        lot = _with_rules(lot, spec.zones)
        if not goal < len(lot.goals):
            raise InputError(f"goal is {goal}, want an index from 0 to {len(lot.goals) - 1}")
        occupancy, window = _occupancy(spec.occupancy, lot, goal), spec.arrivals.window()
        scenario = Scenario(
            name=spec.title,
            lot=lot,
            goal=goal,
            entry=spec.entry,
            v_drive=(spec.speeds.v_drive_kmh or (TOWN_KMH if lot.is_town else LOT_KMH)) * KMH,
            v_walk=spec.speeds.v_walk_kmh * KMH,
            # Costs are fields of the scenario by name: failure_s, give_up_s, ...
            **spec.costs.model_dump(exclude={"prices"}),
            tariff=Tariff(spec.costs.prices),
            priced_at_s=window.weekdays[0] * DAY_S + (window.start_s + window.end_s) / 2,
            sensor_model=sensor_model(spec.sensor_model),
            occupancy=occupancy,
            prior=_prior(spec.forecast, occupancy, lot, goal),
            arrival=window,
            demand=demand_of(spec.demand, lot, window),
            traffic=Traffic(**(spec.traffic.model_dump() if spec.traffic else {})),
            cues=spec.cues,
            rig=spec.rig,
            detector=spec.detector,
        )
        error = spec.occupancy.day_error
        return scenario if error is None else _with_day_error(scenario, error)
    except InputError as error:
        message = str(error)
        for kind in ("goal", "entry"):
            if spec.lot.file is not None and f"no {kind}:" in message:
                message += f'; add one to the file: a Point with the properties {{"kind": "{kind}"}}'
                break
        # A scenario that is a lot alone has the lot's file.
        source = "" if message.startswith(f"{spec.source}: ") else f"{spec.source}: "
        raise InputError(f"{source}{message}") from error


def _with_day_error(scenario: Scenario, day_error: DayError | float) -> Scenario:
    """Return the scenario with other days, and with a forecast that states their error, unless it is from a map."""
    with naming("day_error"):
        day_error = day_error if isinstance(day_error, DayError) else DayError(day_error)
    occupancy, prior, walk = scenario.occupancy, scenario.prior, scenario.walk_s
    if not occupancy.adjustable:
        raise InputError(f"day_error: the occupancy is a {type(occupancy).__name__}, want a process")
    return scenario.replace(
        occupancy=occupancy.with_day_error(day_error, walk),
        prior=prior and prior.with_day_error(day_error, walk),
    )


def _with_rules(lot: ParkingLot, zones: Mapping[str, ZoneSpec]) -> ParkingLot:
    if not zones:
        return lot
    rules = {name: lot.zone_rules.get(name, Zone(name)) for name in lot.zones} | dict(lot.zone_rules)
    for name, spec in zones.items():
        with naming(f"zones.{name}"):
            if name not in rules:
                raise InputError(f"lot {lot.name!r:.40} has no zone {name!r:.40}; {nearest(name, rules)}")
            for user in (user for user in spec.users or () if user not in lot.classes):
                raise InputError(f"users has {user!r:.40}, no class of the lot; {nearest(user, lot.classes)}")
            rules[name] = spec.changed_rules(rules[name])
    return lot.with_rules(rules)


def _lot(spec: LotSpec) -> ParkingLot:
    if spec.name is not None:
        return packaged_lot(spec.name)
    if spec.file is not None:
        return read_lot(spec.file)
    if spec.grid is not None:
        return grid_lot(**spec.grid.model_dump())
    assert spec.city is not None
    return city_lot(spec.city.slots, spec.city.seed)


def _occupancy(spec: OccupancySpec, lot: ParkingLot, goal: int) -> OccupancyModel:
    if spec.log is not None:
        from parkenv.world.occupancy.log import RecordedFile
        from parkenv.world.occupancy.recorded import read_mapping, same_slots

        file = RecordedFile(tuple(spec.log), spec.timezone, None, spec.columns)
        if file.is_counts:
            require(len(spec.log) == 1, f"log is {len(spec.log)} files of counts, want one")
            names = spec.car_parks or (None,)
            require(len(names) == 1, "car_parks: want one")
            return _occupancy(spec.as_counts(names[0]), lot, goal)
        log = _log(file, tuple(map(_changed, spec.log)))
        _warn_of_faults(log.faults, log.source)
        mapped = None
        if spec.mapping == SAME_SLOTS:
            mapped = same_slots(lot.slot_ids, log)
        elif spec.mapping is not None:
            mapped = read_mapping(spec.mapping, lot.slot_ids, log.slot_ids, log.source)
        return _recorded(spec, log, mapped, lot, goal)
    if spec.counts is not None:
        return _counted(spec, spec.counts, lot, goal)
    if spec.world is not None:
        return _own_world(spec.world, lot, goal)
    if spec.process is not None:
        process = _process(spec.process, lot, goal)
    elif spec.real_week is not None:
        week = real_week_occupancy(lot, goal=goal, **spec.real_week.model_dump())
        process = with_full_facilities(week, lot)
    else:
        process = _typical(spec.typical or TypicalWeek(), lot, goal)
    if spec.event is None:
        return process
    return with_event(process, lot, goal=goal, share=spec.event.share, factor=spec.event.factor)


def _own_world(text: str, lot: ParkingLot, goal: int) -> OccupancyModel:
    options = parse_call(text, "world")
    name = options.pop("name")
    kind = load_class(name, "world", "forecast(arrival)")
    if not issubclass(kind, OccupancyModel):
        raise InputError(f"world {name!r}: derives from {kind.__base__.__name__}, want OccupancyModel")
    try:
        made: OccupancyModel = kind(lot, goal, **options)
    except InputError:
        raise
    except Exception as error:  # a user's class may raise anything
        raise InputError(f"world {text} cannot be made: {type(error).__name__}: {error}") from error
    return made


def _recorded(
    spec: OccupancySpec, log: OccupancyLog, mapped: IntArray | None, lot: ParkingLot, goal: int
) -> OccupancyModel:
    from parkenv.world.occupancy.recorded import RecordedOccupancy

    if mapped is not None and (without := int((mapped < 0).sum())):
        told = f"{without:,} of {mapped.size:,} slots of the lot have no record"
        warnings.warn(f"{log.source}: {told}: they follow the forecast of the others", stacklevel=2)
    days = spec.replay_from, spec.forecast_from or "others"
    return RecordedOccupancy(
        log, lot.walk_m(goal), mapped, *days, lot.facility_of_slot, spec.changes or "midway"
    )


def _counted(occupancy: OccupancySpec, spec: CountsSpec, lot: ParkingLot, goal: int) -> OccupancyModel:
    from parkenv.forecast.typical_week_fit import usual_days
    from parkenv.world.occupancy.counted import CountedOccupancy, car_park_of_slots, log_of_counts

    counts, first = _counts(*_file_of(spec)), occupancy.replay_from
    pull = attraction(lot, goal, spec.pull, spec.unevenness)
    if occupancy.mapping is not None:
        _warn_of_faults(counts.total_faults(), counts.source)
        of_slot = car_park_of_slots(occupancy.mapping, lot, counts)
        log = log_of_counts(counts, of_slot, lot.slot_ids, pull)
        return _recorded(occupancy, log, np.where(of_slot < 0, -1, np.arange(lot.n_slots)), lot, goal)
    name = spec.car_park
    if name is None:
        name = counts.car_parks[0]
        if len(counts.car_parks) > 1:
            among = ", ".join(counts.car_parks[:5]) + (", ..." if len(counts.car_parks) > 5 else "")
            raise InputError(
                f"{spec.file}: has {len(counts.car_parks)} car parks, want --car-park, one of {among}"
            )
    elif name not in counts.car_parks:
        counts.chosen([name])  # says which names there are
    row, start, source = counts.car_parks.index(name), 0, f"{spec.file}: car park {name}"
    _warn_of_counts(counts, row, source, is_stated=isinstance(spec.capacity, float))
    if counts.moments:
        log = log_of_counts(counts, np.full(lot.n_slots, row), lot.slot_ids, pull)
        return _recorded(occupancy, log, np.arange(lot.n_slots), lot, goal)
    if first is None:
        mean, sd = usual_days(counts.occupied[row], counts.weekday, source)
    else:
        forecast = _forecast(*_file_of(spec), first, occupancy.forecast_from == "past")
        start, mean, sd = forecast.first, forecast.mean[row], forecast.sd[row]
    return CountedOccupancy(
        tuple(day.isoformat() for day in counts.days[start:]),
        counts.occupied[row, start:],
        mean,
        sd,
        pull,
        spec.mean_stay_s,
        source,
    )


def _warn_of_faults(faults: Mapping[str, int], source: str) -> None:
    text = listed_faults({name: n for name, n in faults.items() if name not in ("summer_time", "gap")})
    if text:
        warnings.warn(f"{source}: readings corrected or left out: {text}", stacklevel=2)


def _warn_of_counts(counts: Counts, row: int, source: str, *, is_stated: bool) -> None:
    """Tell which readings are not used as they are, and of counts that may be percentages."""
    _warn_of_faults(counts.faults[row], source)
    taken, whole = counts.occupied[row] * counts.capacity[row, :, None], counts.capacity[row].max()
    highest = np.nanmax([taken, counts.capacity[row, :, None] - taken], axis=(1, 2)).round(6)
    if is_stated and whole > 100.0 and 100.0 in highest:
        warnings.warn(
            f"{source}: counts end at 100 of {whole:g} places; if they are percentages, give --capacity 100",
            stacklevel=2,
        )


def _changed(file: Path) -> int:
    return file.stat().st_mtime_ns if file.exists() else 0


@lru_cache(maxsize=2)
def _log(file: RecordedFile, changed: tuple[int, ...]) -> OccupancyLog:  # noqa: ARG001
    """Read a log once for all scenarios that replay it: they share the models that are fitted to its days."""
    return file.log()


def _file_of(spec: CountsSpec) -> tuple[RecordedFile, int]:
    from parkenv.world.occupancy.log import RecordedFile

    return RecordedFile((spec.file,), spec.timezone, spec.capacity, spec.columns), _changed(spec.file)


@lru_cache(maxsize=2)
def _counts(file: RecordedFile, changed: int) -> Counts:  # noqa: ARG001
    return file.counts()


@lru_cache(maxsize=2)
def _forecast(file: RecordedFile, changed: int, first: date, past: bool) -> DayForecast:
    """Forecast all days from the first one on; car parks learn special days from one another."""
    from parkenv.forecast.day_curves import CurveSettings, forecast_days

    counts = _counts(file, changed)
    index, n, least = counts.day_index(first), len(counts.days), counts.days[0] + timedelta(MIN_PAST_DAYS)
    if not MIN_PAST_DAYS <= index < n:
        wanted = f"one from {least} on" if n > MIN_PAST_DAYS else "a longer record, or no replay_from"
        raise InputError(
            f"{file.files[0]}: replay_from is {first}, and the record has {n} days, {counts.days[0]} to "
            f"{counts.days[-1]}: the forecast needs {MIN_PAST_DAYS} days before; want {wanted}"
        )
    return forecast_days(counts, index, "past" if past else "rolling", CurveSettings())


def car_parks(spec: CountsSpec) -> list[str]:
    counts = _counts(*_file_of(spec))
    return [name for name in counts.car_parks if name not in counts.idle()]


def _prior(spec: ForecastSpec, occupancy: OccupancyModel, lot: ParkingLot, goal: int) -> PriorModel | None:
    if spec.typical is not None:
        return _typical(spec.typical, lot, goal)
    if spec.process is not None:
        return _process(spec.process, lot, goal)
    if spec.flat is not None:
        return ConstantForecast(spec.flat, occupancy)
    if spec.map is not None:
        from parkenv.mapping.learned_map import map_prior
        from parkenv.mapping.store import MapStore

        with MapStore(spec.map, lot, create=False) as store:
            return map_prior(store.log(), store.trips(), lot.walk_m(goal))
    return None


def _typical(spec: TypicalWeek, lot: ParkingLot, goal: int) -> OccupancyProcess:
    parameters = spec.model_dump(exclude={"goal"})
    week = typical_occupancy(lot, goal=goal if spec.goal is None else spec.goal, **parameters)
    return with_full_facilities(week, lot)


def _process(path: Path, lot: ParkingLot, goal: int) -> OccupancyProcess:
    process = OccupancyProcess.from_file(path)
    # A process has no slot ids: if its number of slots equals the lot's, assume that it was made for this lot.
    return process if process.n_slots == lot.n_slots else process.mapped_to_lot(lot.walk_m(goal))


def sensor_model(spec: SensorModelSpec) -> SensorModel:
    rates = spec.model_dump(include={"hit_rate", "false_alarm_rate", "view_range"}, exclude_none=True)
    if spec.name == "blind":
        model = SensorModel.blind()
    elif spec.name in ("laser", "stereo"):
        model = SensorModel.named(spec.name)
    else:
        model = SensorModel() if spec.file is None else SensorModel.from_file(spec.file)
    return dataclasses.replace(model, **rates)


def demand_of(
    purposes: Mapping[str, PurposeSpec], lot: ParkingLot, window: ArrivalWindow
) -> TownDemand | None:
    """Return the demand of a scenario's tables, by weights of the lot, or equal ones if another table has some."""
    from parkenv.world.demand import ConstantTime, Demand, TownDemand, weights_of_all

    if not purposes:
        return None
    if window.end_s <= window.start_s:
        raise InputError("arrivals.hours are one time, want hours in which the cars of `demand` arrive")
    ends = {"goals": (lot.goals, lot.goal_weights), "entries": (lot.entries, lot.entry_weights)}
    defaults: dict[str, tuple[float, ...]] = {}
    for field, (points, of_lot) in ends.items():
        some = any(getattr(spec, field) for spec in purposes.values())
        defaults[field] = weights_of_all(of_lot) or ((1.0,) * len(points) if some else ())
    users = {zone.name: zone.users for zone in lot.zone_rules.values()}
    spaces = [
        (users.get(zone, (PUBLIC,)), int(lot.capacity[lot.zone_of_slot == k].sum()))
        for k, zone in enumerate(lot.zones)
    ]
    demands = []
    for name, spec in purposes.items():
        table = f"demand.{name}"
        for user in (user for user in spec.classes if user not in lot.classes[1:]):
            raise InputError(
                f"{table}.classes has {user!r:.40}, no class of lot {lot.name!r:.40} beside {PUBLIC}; "
                f"{nearest(user, lot.classes[1:])}"
            )
        room = sum(n for may, n in spaces if PUBLIC in may or set(may) & set(spec.classes))
        if spec.parked > room:
            raise InputError(
                f"{table}.parked is {spec.parked}, want at most the {room:,} spaces that it may use"
            )
        weights: dict[str, tuple[float, ...]] = {}
        for field, (points, of_lot) in ends.items():
            weights[field] = own = getattr(spec, field) or tuple(of_lot.get(name, defaults[field]))
            if own and len(own) != len(points):
                raise InputError(
                    f"{table}.{field} has {len(own)} numbers, the lot has {len(points)} of these"
                )
        rest = spec.model_dump(include={"value_of_time", "classes", "walks_back", "kwh", "parked"})
        laws = spec.arrivals(window), spec.stay, ConstantTime(spec.patience_s)
        with naming(table):
            demands.append(Demand(*laws, weights["entries"], weights["goals"], name=name, **rest))
    with naming("demand"):
        return TownDemand(tuple(demands))
