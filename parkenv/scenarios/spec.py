"""Specification of a scenario file.

Every table of the file has a class, here or in `parkenv.world`, which validates it. The published JSON schema is made
from these classes.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import PydanticCustomError

from parkenv.errors import InputError, nearest
from parkenv.files.field_types import Name, Probability
from parkenv.files.known_names import (
    DETECTORS,
    LOT_SUFFIXES,
    MAX_CARS,
    PACKAGED_LOTS,
    SAME_SLOTS,
    SCENARIO_NAMES,
    SENSOR_MODELS,
    Changes,
    ForecastFrom,
    PackagedLot,
    RigName,
    SensorModelName,
)
from parkenv.files.limited_reading import is_there
from parkenv.files.option import numbers_in, option, seconds_of_minutes, words_in
from parkenv.files.spec_file import (
    FilePath,
    OrText,
    PackagedDetector,
    Several,
    Spec,
    read_tables,
    resolved_path,
)
from parkenv.files.user_class import find_module
from parkenv.world.cues import SENSED, Cues
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.real_week_figures import DAY_ERROR, FULLER_THAN, PULL, UNEVENNESS
from parkenv.world.tariff import NO_ZONE, VALUE_OF_TIME, Price, Zone, parse_change
from parkenv.world.tariff import Hours as ZoneHours
from parkenv.world.week import DAY_HOURS, HOUR_S

if TYPE_CHECKING:  # help and completion read fields alone
    from parkenv.world.demand import Arrivals as ArrivalLaw
    from parkenv.world.demand import Duration

Speed = Annotated[float, Field(ge=0.1, le=300.0)]  # km/h
Cost = Annotated[float, Field(ge=0.0, le=86_400.0)]  # s, at most a day
Count = Annotated[int, Field(ge=0, le=1_000)]
Size = Annotated[float, Field(ge=1.0, le=100.0)]  # m
MAX_SLOTS = 1_000_000


def _require_one(spec: Spec, names: tuple[str, ...], least: int = 1) -> None:
    given = [name for name in names if getattr(spec, name) is not None]
    if not least <= len(given) <= 1:
        raise ValueError(f"{'exactly' if least else 'at most'} one of {', '.join(names)}")


class GridLot(Spec):
    """Rows of perpendicular slots along parallel two-way aisles."""

    rows: int = Field(ge=1, le=10_000)
    columns: int = Field(ge=1, le=10_000, description="Slots per row.")
    pitch: Size = Field(2.5, description="Width of a slot, m.")
    depth: Size = Field(5.0, description="Length of a slot, m.")
    aisle: Size = Field(6.0, description="Width of an aisle, m.")

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if self.rows * self.columns > MAX_SLOTS:
            raise ValueError(f"rows times columns of at most {MAX_SLOTS} slots")
        return self


class CityLot(Spec):
    """Kerbside slots around the blocks of a generated city."""

    slots: int = Field(ge=1, le=MAX_SLOTS)
    seed: int = Field(0, ge=0, lt=2**32)


def _from_text(table_of: Callable[[str], dict[str, Any]]) -> BeforeValidator:
    return BeforeValidator(lambda value: table_of(str(value)) if isinstance(value, str | Path) else value)


def _lot_table(text: str) -> dict[str, Any]:
    if not text.endswith(LOT_SUFFIXES) and text not in PACKAGED_LOTS:
        raise ValueError(
            f"a packaged lot ({', '.join(PACKAGED_LOTS)}) or a lot file ({', '.join(LOT_SUFFIXES)})"
        )
    return {"name" if text in PACKAGED_LOTS else "file": text}


class LotSpec(Spec):
    """Source of the lot: exactly one of the four."""

    name: PackagedLot | None = Field(None, description="A packaged lot.")
    file: FilePath | None = Field(
        None, description="A lot file: native GeoJSON, or a Dragon Lake map (.yml)."
    )
    grid: GridLot | None = None
    city: CityLot | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        _require_one(self, ("name", "file", "grid", "city"))
        return self


class _Popularity(Spec):
    """Which slots drivers like, and how long they stay."""

    pull: float = Field(
        1.6, ge=-20, le=20, description="Rise of demand from the middle of the lot to the goal, logits."
    )
    unevenness: float = Field(
        0.6, ge=0, le=20, description="Standard deviation between slots equally near to the goal, logits."
    )
    mean_stay_s: float = Field(7200.0, ge=1.0, le=1e7)


class TypicalWeek(_Popularity):
    """A working week: full by day, empty by night, fuller near the goal."""

    demand: float = Field(0.0, ge=-50, le=50, description="Logits added at every hour.")
    goal: int | None = Field(
        None, ge=0, description="Index of the goal with the demand; the scenario's own if absent."
    )


class RealWeek(Spec):
    """A week as counted in real car parks: what a lot file alone has."""

    fuller_than: Probability = Field(
        FULLER_THAN, description="Fraction of real car parks that are less full; 0.5 for the typical one."
    )
    pull: float = Field(
        PULL, ge=-10, le=10, description="Rise of demand from the middle of the lot to the goal, logits."
    )
    unevenness: float = Field(
        UNEVENNESS,
        ge=0,
        le=5,
        description="Standard deviation between slots equally near to the goal, logits.",
    )
    mean_stay_s: float = Field(7200.0, ge=60.0, le=1e7)


class Event(Spec):
    """A day on which the slots nearest to the goal fill up."""

    share: Probability = Field(description="Fraction of the slots that the event fills, the nearest ones.")
    factor: float = Field(gt=0, le=1e6, description="Factor of their arrival rates.")


def _occupancy_table(text: str) -> dict[str, Any]:
    if text in ("typical", "real-week"):
        return {text.replace("-", "_"): {}}
    for kind, endings in (("process", ".json"), ("log", (".csv", ".csv.gz"))):
        if text.endswith(endings):
            return {kind: text}
    if ":" in text:
        return {"world": text}
    raise ValueError(
        "typical, real-week, a process (.json), a recorded log (.csv, .csv.gz), MODULE:CLASS, or a table"
    )


def _mapping(value: object, info: ValidationInfo) -> object:
    return value if value == SAME_SLOTS else resolved_path(value, info)


def _date(value: object) -> object:
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = date.fromisoformat(value)
    if not isinstance(value, date) or isinstance(value, datetime):
        raise ValueError("a date such as 2015-11-20")
    return value


Date = Annotated[date, BeforeValidator(_date)]


def _day_error_tables(value: object) -> object:
    return {"level": value} if isinstance(value, int | float) and not isinstance(value, bool) else value


def _day_error_text(text: str) -> object:
    return dict(zip(("level", "slope"), numbers_in(text, min(text.count(",") + 1, 2)), strict=False))


Places = Annotated[float, Field(gt=0, le=1e6)]


def _capacity(value: object, info: ValidationInfo) -> object:
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            return float(value)
    return value if not isinstance(value, str | Path) or value == "largest" else resolved_path(value, info)


CAPACITY_HELP = (
    "Places of the car park, if no column has them; a table of car parks and their capacities (.csv); or largest: "
    "the largest count of each."
)
Capacity = Annotated[Places | Literal["largest"] | Path, BeforeValidator(_capacity)]


TIMEZONE_HELP = (
    "Local time zone of a recorded log or counts, wanted if their times are in UTC or have an offset."
)
COLUMNS_HELP = (
    "Columns of a recorded log or counts with other names than the usual ones, by what they mean: bay, arrival, "
    "departure, since, updated, time, state; car_park, capacity, free, taken, hour, time, date. `_utc` behind a time: "
    "in UTC."
)
COLUMNS_TAKE = "MEANING=COLUMN[,...]"


class CountsSpec(_Popularity):
    """Days of car parks of which the number of free places was counted, replayed on the lot."""

    file: FilePath = Field(
        description="Counts: car_park,capacity,hour,free, each at its hour's end, or `time` for points in "
        "time; .csv, .csv.gz."
    )
    car_park: str | None = Field(None, description="Name of the car park in the file, if there are several.")
    capacity: Capacity | None = Field(None, description=CAPACITY_HELP)
    timezone: str | None = Field(None, description=TIMEZONE_HELP)
    columns: str | None = Field(None, description=COLUMNS_HELP)


_Logs = Annotated[
    Several[FilePath],
    BeforeValidator(lambda value: value.split(",") if isinstance(value, str) else value),
    Field(min_length=1),
    OrText(),
]


class OccupancySpec(Spec):
    """When slots are taken: a typical week by default."""

    typical: TypicalWeek | None = None
    real_week: RealWeek | None = None
    process: FilePath | None = Field(None, description="Rates from `parkenv occupancy fit` (.json).")
    log: _Logs | None = Field(
        None, description="A recorded log (.csv, .csv.gz), or several of the same slots, replayed day by day."
    )
    counts: CountsSpec | None = None
    car_parks: Several[str] | None = option(
        None,
        "With --occupancy as a file of counts, car_park,capacity,hour,free: replay the days of these car parks "
        "on the lot, each as a separate scenario. all: all car parks in use.",
        name="--car-park",
        takes="NAME[,NAME...]|all",
        panel="World",
        default="the file's only one",
        parse=words_in,
    )
    capacity: Capacity | None = option(
        None, CAPACITY_HELP, takes="PLACES|FILE|largest", panel="World", default="the file's", parse=str
    )
    timezone: str | None = option(None, TIMEZONE_HELP, takes="NAME", panel="World", default="times are local")
    columns: str | None = option(
        None, COLUMNS_HELP, takes=COLUMNS_TAKE, panel="World", default="found by their names", parse=str
    )
    world: str | None = Field(
        None,
        description="An `OccupancyModel` of your own, `MODULE:CLASS` with any options in brackets: a class whose first "
        "arguments are the lot and the index of the goal. For experiments; a scenario file names none.",
    )
    replay_from: Date | None = option(
        None,
        "First replayed day of the log or the counts; without it, days are drawn from all.",
        takes="DATE",
        panel="World",
        default="the scenario's, all",
    )
    forecast_from: ForecastFrom | None = option(
        None,
        "Days used for the forecast. past: those before the first replayed day; rolling: those "
        "before the earliest that a world replays; others: all that it does not replay.",
        panel="World",
        default="the scenario's; others, with counts and --replay-from rolling",
    )
    mapping: Annotated[Path | str, BeforeValidator(_mapping)] | None = option(
        None,
        "CSV slot_id,log_slot_id that assigns the log's slots, or the car parks of counts, to the lot's slots; same: "
        "those of the same names, or facilities and zones named as car parks.",
        takes="FILE|same",
        panel="World",
        default="the log's fullest slots are nearest to the goal",
    )
    changes: Changes | None = option(
        None,
        "When a state changes between two looks of a recorded log: midway, for all slots at once; drawn: each at its "
        "own moment, by the forecast's law given both looks.",
        panel="World",
        default="midway",
    )
    event: Event | None = None
    day_error: Annotated[DayError, BeforeValidator(_day_error_tables), OrText("number")] | None = option(
        None,
        "Difference of whole days from the forecast: standard deviations, logits, of their level "
        "and of their slope to the goal; 0: days are as forecast.",
        takes="X[,Y]",
        panel="World",
        parse=_day_error_text,
        default="the scenario's, 0.8 in the packaged ones, 0.7 for a lot alone",
    )

    @model_validator(mode="after")
    def _one(self) -> Self:
        _require_one(self, ("typical", "real_week", "process", "log", "counts", "world"), least=0)
        recorded, own_days = bool(self.log or self.counts), self.day_error is not None
        dated = self.replay_from is not None
        for fault, wanted in (
            (
                self.world and (own_days or self.event),
                "day_error and event only without a world, which has days",
            ),
            (
                own_days and recorded,
                "day_error only without a log or counts, whose days differ by themselves",
            ),
            (
                (self.car_parks or self.capacity) and not self.log,
                "car_parks and capacity only together with counts as the log",
            ),
            (
                (self.timezone or self.columns) and not self.log,
                "timezone and columns only together with a log",
            ),
            (self.mapping is not None and not recorded, "mapping only together with a log or counts"),
            (dated and not recorded, "replay_from only together with a log or counts"),
            (
                self.counts and dated and self.forecast_from == "others",
                "forecast_from rolling or past together with counts and replay_from",
            ),
            (self.forecast_from not in (None, "others") and not dated, "forecast_from only with replay_from"),
            (self.changes and not self.log, "changes only together with a log"),
            (self.event and recorded, "event only without a log or counts, whose days have their events"),
        ):
            if fault:
                raise ValueError(wanted)
        return self

    def as_counts(self, car_park: str | None) -> OccupancySpec:
        """Return this occupancy with its log, a table of counts, as `counts` of a car park, or of the only one."""
        assert self.log is not None
        options = {name: getattr(self, name) for name in ("capacity", "timezone", "columns")}
        moved = dict.fromkeys(("log", "car_parks", *options))
        counts = {"file": self.log[0], "car_park": car_park, **options}
        return self.changed("--car-park", **moved, counts=counts)

    def files(self) -> list[Path]:
        module = find_module(self.world) if self.world else None
        return [*super().files(), *([Path(module)] if module else [])]


def _forecast_table(text: str) -> dict[str, Any]:
    kind = {".json": "process", ".sqlite": "map"}.get(Path(text).suffix)
    if kind is None and text != "own":
        raise ValueError("own, a process (.json), a map file (.sqlite), or a table")
    return {kind: text} if kind else {}


class ForecastSpec(Spec):
    """Occupancy forecast before the search: by default that of the true occupancy model."""

    typical: TypicalWeek | None = None
    process: FilePath | None = None
    map: FilePath | None = Field(None, description="A map file of `parkenv survey` (.sqlite).")
    flat: Probability | None = Field(None, description="The same probability for every slot.")

    @model_validator(mode="after")
    def _one(self) -> Self:
        _require_one(self, ("typical", "process", "map", "flat"), least=0)
        return self


def _hours(value: str) -> str:
    try:
        ArrivalWindow.parse(value)
    except InputError:
        raise ValueError("HH:MM-HH:MM within one day, e.g. 08:00-13:00") from None
    return value


Hours = Annotated[str, AfterValidator(_hours)]  # HH:MM-HH:MM


def _days(value: object) -> object:
    text = ",".join(value) if isinstance(value, list) and all(isinstance(v, str) for v in value) else value
    try:
        ArrivalWindow.parse("00:00-24:00", text if isinstance(text, str) else "")
    except InputError:
        raise ValueError("weekdays, weekend, all, or names of days such as mon,tue") from None
    return text


class Arrivals(Spec):
    """When searches begin."""

    days: Annotated[str, BeforeValidator(_days)] = option(
        "weekdays",
        "weekdays, weekend, all, or names such as mon,tue.",
        takes="DAYS",
        panel="World",
        default="the scenario's, weekdays",
    )
    hours: Hours = option(
        "08:00-13:00",
        "Searches begin between these hours.",
        takes="HH:MM-HH:MM",
        panel="World",
        default="the scenario's, 08:00-13:00",
    )

    def window(self) -> ArrivalWindow:
        return ArrivalWindow.parse(self.hours, self.days)


class Speeds(Spec):
    """Speeds on the lanes and on foot."""

    v_drive_kmh: Speed | None = Field(
        None, description="10 in a car park, 20 in a town (a lot with facilities) if absent."
    )
    v_walk_kmh: Speed = 4.0


MAX_PRICE = 1e6  # highest price per hour


def _price(text: str) -> tuple[str, object]:
    """Parse ZONE=AMOUNT/h, ZONE=+AMOUNT/h, or ZONE=AMOUNT@HOURS;AMOUNT@HOURS."""
    zone, equals, amount = text.rpartition("=")
    if not (zone and equals):
        raise InputError(f"is {text!r:.60}, want ZONE=AMOUNT/h, such as centre=2/h")
    price, is_added = parse_change(amount)
    if price.hourly:
        return zone, amount
    return zone, f"+{price.per_hour:g}" if is_added else price.per_hour


def _amount(value: object) -> object:
    per_hour = math.inf
    if isinstance(value, int | float | str):
        with contextlib.suppress(InputError):
            per_hour = parse_change(value)[0].per_hour
    if per_hour > MAX_PRICE:
        raise ValueError(f"a number from 0 to {MAX_PRICE:g}, a text such as +1, or 1 @ 08:00-12:00")
    return value if isinstance(value, str) else per_hour


_PRICE = {"anyOf": [{"type": "number", "minimum": 0, "maximum": MAX_PRICE}, {"type": "string"}]}
_Amount = Annotated[float | str, BeforeValidator(_amount), WithJsonSchema(_PRICE)]


def _prices(value: object) -> object:
    if not isinstance(value, tuple):
        return value
    zones = [zone for zone, _ in value]
    if repeated := [zone for i, zone in enumerate(zones) if zone in zones[:i]]:
        raise ValueError(f"one price for each zone, not two for {repeated[0]!r:.40}")
    return dict(value)


class Costs(Spec):
    """Costs of a search, s, and the prices of parking."""

    failure_s: Cost = Field(10.0, description="Cost of a failed parking attempt; planners know it.")
    wait_s: float = Field(
        1.0, gt=0.0, le=86_400.0, description="Cost of a move that the drive graph does not have."
    )
    give_up_s: Cost = Field(1800.0, description="Give-up penalty: park elsewhere and walk.")
    prices: Annotated[dict[str, _Amount], BeforeValidator(_prices)] = option(
        {},
        f"Price of an hour in a zone of the lot, in any currency; {NO_ZONE}: in slots without a zone; +AMOUNT is "
        "added; AMOUNT@HH:MM-HH:MM;... by hours. Once for each zone; * stands for any letters of the names of paid "
        "zones.",
        name="--price",
        takes="ZONE=[+]AMOUNT/h",
        panel="Prices",
        parse=_price,
        repeat=True,
        default="the scenario's, none",
    )
    value_of_time: float = option(
        VALUE_OF_TIME,
        "Value of an hour of the driver's time, in the same currency; converts payments to time.",
        takes="AMOUNT/h",
        panel="Prices",
        parse=lambda text: Price.parse(text).per_hour,
        default=f"the scenario's, {VALUE_OF_TIME:g}",
        gt=0.0,
        le=1e6,
    )
    stay_s: float = option(
        HOUR_S,
        "Expected stay, for the price; in a fleet each car knows its own.",
        name="--stay-min",
        takes="MINUTES",
        panel="Prices",
        parse=seconds_of_minutes,
        default="the scenario's, 60",
        ge=1.0,
        le=1e7,
    )


def _sensor_table(text: str) -> dict[str, Any]:
    if not text.endswith(".json") and text not in SENSOR_MODELS:
        raise ValueError(f"{', '.join(SENSOR_MODELS)} or a file (.json)")
    return {"name" if text in SENSOR_MODELS else "file": text}


class SensorModelSpec(Spec):
    """How slots are observed from the lane."""

    name: SensorModelName | None = Field(
        None, description="perfect; blind: only by attempts; laser, stereo: fitted to that rig."
    )
    file: FilePath | None = Field(None, description="A sensor model of `parkenv fit-sensor-model`.")
    hit_rate: Probability | None = Field(None, description="P(observed taken | taken).")
    false_alarm_rate: Probability | None = Field(None, description="P(observed taken | free).")
    view_range: float | None = option(
        None,
        "Range within which the car observes slots, m.",
        takes="M",
        panel="Sensors",
        default="the sensor model's",
        ge=0.0,
        le=10_000.0,
    )

    @model_validator(mode="after")
    def _one(self) -> Self:
        _require_one(self, ("name", "file", "hit_rate"), least=0)
        if (self.hit_rate is None) != (self.false_alarm_rate is None):
            raise ValueError("hit_rate and false_alarm_rate together")
        if self.hit_rate is not None and self.hit_rate <= (self.false_alarm_rate or 0.0):
            raise ValueError("a hit_rate above the false_alarm_rate")
        return self


def _cues_table(text: str) -> dict[str, Any]:
    if text == "perfect":
        return {}
    numbers = SENSED if text == "sensed" else numbers_in(text)
    if len(numbers) not in (2, 3):
        raise ValueError("perfect, sensed, or HIT,FALSE_ALARM[,LEAD_S]")
    return dict(zip(("hit_rate", "false_alarm_rate", "lead_s"), numbers, strict=False))


class TrafficSpec(Spec):
    """Other road users."""

    cars: Count = option(0, "Other moving cars.", panel="World", default="the scenario's")
    pedestrians: Count = option(0, "Pedestrians.", panel="World", default="the scenario's")


def _goal(value: object) -> object:
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value
    point = value if isinstance(value, list | tuple) else ()
    if len(point) == 2 and all(type(v) in (int, float) and abs(v) <= 1e7 for v in point):
        return tuple(map(float, point))
    raise ValueError("the index of one of the lot's goals, or a point [x, y] in m")


def _name(value: str) -> str:
    if len(value) > 80 or not value.isprintable() or set(value) & set("/\\,"):
        raise ValueError("at most 80 printable characters without comma or slash")
    return value


MAX_RATE = 1e6  # maximum number of cars an hour
Rate = Annotated[float, Field(ge=0.0, le=MAX_RATE)]
# Of each hour of the day; a number is that of all.
Rates = Annotated[
    Several[Rate],
    Field(min_length=DAY_HOURS, max_length=DAY_HOURS),
    BeforeValidator(lambda value: [value] * DAY_HOURS if isinstance(value, int | float) else value),
    OrText("number"),
]
Weights = Several[Annotated[float, Field(ge=0.0, le=1e12)]]


PurposeName = Annotated[Name, Field(min_length=1, max_length=80)]


class PurposeSpec(Spec):
    """Drivers with one purpose: when they arrive, how long they stay, where they go, and what they may and mind."""

    arrivals_per_hour: Rates = Field(
        description="Cars an hour, one number or 24, one for each hour of the day."
    )
    stay_s: float = Field(3600.0, ge=1.0, le=1e7, description="Mean stay.")
    stay_law: Literal["exponential", "log-normal", "constant"] = "exponential"
    stay_cv: float = Field(1.0, gt=0.0, le=10.0, description="Coefficient of variation of log-normal stays.")
    value_of_time: float | None = Field(
        None,
        gt=0.0,
        le=1e6,
        description="Value of an hour of the drivers' time, in the currency of the prices; that of `costs` if "
        "absent.",
    )
    classes: dict[str, Annotated[float, Field(ge=0.0, le=1.0)]] = Field(
        {}, description="Share of the drivers of each class, for example permit-a, disabled or charging."
    )
    walks_back: bool = Field(False, description="Whether the walk back to the car counts, too.")
    patience_s: float = Field(
        600.0,
        gt=0.0,
        le=1e7,
        description="Search time, without the drive to the goal, after which cars go elsewhere.",
    )
    kwh: float = Field(0.0, ge=0.0, le=1e3, description="Energy that a car of the class charging takes, kWh.")
    parked: int = Field(0, ge=0, le=MAX_CARS, description="Cars that are parked when the hours begin.")
    goals: Weights = Field(
        (), description="Weight of each goal of the lot; those of the lot for this purpose if absent."
    )
    entries: Weights = Field(
        (), description="Weight of each entry of the lot; those of the lot for this purpose if absent."
    )

    @property
    def stay(self) -> Duration:
        from parkenv.world.demand import ConstantTime, ExponentialTime, LogNormalTime

        if self.stay_law == "log-normal":
            return LogNormalTime(self.stay_s, self.stay_cv)
        return (ConstantTime if self.stay_law == "constant" else ExponentialTime)(self.stay_s)

    def arrivals(self, window: ArrivalWindow) -> ArrivalLaw:
        from parkenv.world.demand import NoArrivals, PoissonArrivals

        start, end = int(window.start_s // 3600), math.ceil(window.end_s / 3600)
        if not any(self.arrivals_per_hour[start:end]):
            return NoArrivals(window.start_s)
        return PoissonArrivals(self.arrivals_per_hour, window.start_s, window.end_s)


class ZoneSpec(Spec):
    """Rules of a zone in place of the lot's; it keeps those that are not given."""

    price: Annotated[
        float | str | dict[str, Any] | None, WithJsonSchema({"type": ["number", "string", "object"]})
    ] = Field(
        None, description="Price per hour, prices by time of day (1 @ 08:00-12:00), or as in a lot file."
    )
    hours: str | None = Field(
        None, description="When parking is allowed: 'Mo,Tu,Th-Su 00:00-24:00; We 14:00-24:00', 24/7, off."
    )
    max_stay_s: float | None = Field(None, ge=0.0, le=1e7, description="Longest stay; 0: no limit.")
    users: Several[str] | None = Field(None, description="Classes of drivers who may park there.")

    def changed_rules(self, zone: Zone) -> Zone:
        own: dict[str, Any] = {"price": Price.parse(self.price)} if self.price is not None else {}
        if self.hours is not None:
            own["hours"] = ZoneHours.parse(self.hours)
        if self.max_stay_s is not None:
            own["max_stay_s"] = self.max_stay_s or None
        if self.users is not None:
            own["users"] = self.users
        return replace(zone, **own)


# Tables of a scenario of which each value may be another one than the base's; others are replaced whole.
_MERGED = ("arrivals", "costs", "demand", "speeds", "zones")


def _merged(base: object, value: object) -> object:
    if not (isinstance(base, Mapping) and isinstance(value, Mapping)):
        return value
    return {**base, **{name: _merged(base.get(name), own) for name, own in value.items()}}


def _lot_or_base(schema: dict[str, Any]) -> None:
    schema["anyOf"] = [{"required": schema.pop("required")}, {"required": ["base"]}]


class ScenarioSpec(Spec):
    """A scenario file: lot, occupancy, forecast, sensor model, goal, speeds and costs."""

    model_config = ConfigDict(json_schema_extra=_lot_or_base)

    name: Annotated[str, AfterValidator(_name)] = Field(
        "", description="Name in tables; the file's name by default."
    )
    lot: Annotated[LotSpec, _from_text(_lot_table), OrText()]
    goal: Annotated[int | tuple[float, float], BeforeValidator(_goal)] = option(
        0,
        "Walk to this point, m, or to the lot's goal of this index.",
        takes="X,Y",
        panel="World",
        parse=lambda text: int(text) if text.isdecimal() else numbers_in(text, 2),
        default="the scenario's",
    )
    entry: int | None = Field(None, ge=0, description="Index of the entry; drawn for each search if absent.")
    occupancy: Annotated[OccupancySpec, _from_text(_occupancy_table), OrText()] = option(
        OccupancySpec(),
        "States of the slots: recorded logs (.csv, .csv.gz) of the same slots or counts of a car park, replayed day "
        "by day; a process of `parkenv occupancy fit` (.json); or your own world, MODULE:CLASS.",
        takes="FILE[,FILE...]|MODULE:CLASS",
        panel="World",
        default="the scenario's",
        sets={"forecast": "own"},
    )
    forecast: Annotated[ForecastSpec, _from_text(_forecast_table), OrText()] = ForecastSpec()
    arrivals: Arrivals = Arrivals()
    demand: dict[PurposeName, PurposeSpec] = Field(
        {}, description="Demand of many cars by purpose, in the hours of `arrivals`."
    )
    zones: dict[str, ZoneSpec] = Field({}, description="Rules of zones in place of the lot's, by name.")
    speeds: Speeds = Speeds()
    costs: Costs = Costs()
    sensor_model: Annotated[SensorModelSpec, _from_text(_sensor_table), OrText()] = option(
        SensorModelSpec(name="perfect"),
        "How slots are observed. perfect: without error; blind: only by attempts; laser, stereo: "
        "fitted to that rig; a file of `parkenv fit-sensor-model`.",
        takes="NAME|FILE",
        panel="Sensors",
        default="the scenario's; with --rig, the rig's",
    )
    cues: Annotated[Cues, _from_text(_cues_table), OrText()] | None = option(
        None,
        "Cars show that they are about to leave. perfect: without error; sensed: as simulated sensors see it; or P(cue "
        "| about to leave) and P(cue | not) at each observation, and the mean time before the departure, s.",
        takes="perfect|sensed|HIT,FALSE_ALARM[,LEAD_S]",
        panel="World",
        default="none",
    )
    rig: RigName = Field("laser", description="The simulated sensors of the car.")
    detector: PackagedDetector = Field(
        "hog", description="Detector for their images: hog, side, front, net, or a file (.npz, .onnx)."
    )
    traffic: TrafficSpec | None = Field(
        None, description="Other road users; none if absent, some in surveys."
    )
    base: PackagedLot | None = Field(
        None,
        description="A packaged scenario that supplies omitted keys, also single values of arrivals, costs, "
        "demand, speeds, zones.",
    )

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, tables: Any) -> Any:
        if not isinstance(tables, Mapping) or tables.get("base") is None:
            return tables
        if tables["base"] not in SCENARIO_NAMES:
            given, known = repr(tables["base"])[:80], ", ".join(SCENARIO_NAMES)
            raise PydanticCustomError(
                "whole", "base is {given}, want {known}", {"given": given, "known": known}
            )
        base = cls.read(_PACKAGED / f"{tables['base']}.toml").tables() | {"name": ""}
        return base | {
            name: _merged(base.get(name), value) if name in _MERGED else value
            for name, value in tables.items()
            if name != "base"
        }

    @property
    def title(self) -> str:
        lot = self.lot
        return self.name or lot.name or (lot.file.stem if lot.file else "city" if lot.city else "grid")

    @classmethod
    def read(cls, path: str | Path) -> Self:
        path = Path(path)
        spec = cls.parse({"name": path.stem, **read_tables(path)}, str(path), path.parent).of_file(path)
        if spec.occupancy.world is not None:
            # Scenario files hold no code.
            raise InputError(
                f"{path}: occupancy is {spec.occupancy.world!r:.80}, want no class in a scenario file; a world of your "
                "own is named by --occupancy or in an experiment"
            )
        return spec

    def files(self) -> list[Path]:
        files = super().files()
        if self.detector not in DETECTORS:
            detector = Path(self.detector)
            beside = [detector.with_suffix(".toml")] if detector.suffix.lower() == ".onnx" else []
            files += [detector, *(file for file in beside if is_there(file))]
        return list(dict.fromkeys(files))

    @property
    def source(self) -> str:
        return self._file or f"scenario {self.title!r}"

    @property
    def argument(self) -> str:
        return self._file or self.title


_PACKAGED = Path(__file__).with_name("packaged")


def scenario_spec(source: str | Path) -> ScenarioSpec:
    """Return the specification of one scenario; see `scenario_specs`.

    Examples:
        >>> scenario_spec("jam").occupancy.event
        Event(share=0.75, factor=200.0)
    """
    specs = scenario_specs(source)
    if len(specs) > 1:
        raise InputError(f"{source}: holds {len(specs)} scenarios, want one")
    return specs[0]


def scenario_specs(source: str | Path) -> list[ScenarioSpec]:
    """Return the specifications that a name, a file or a folder stands for.

    A lot file (.geojson, .yml) has a week as counted in real car parks (`lot_scenario`). In a folder, scenario files
    (.toml) and lot files (.geojson) follow in order of their names; a lot that a scenario file of it names is that
    scenario's.

    Examples:
        >>> [spec.title for spec in scenario_specs("mini")]
        ['mini']
    """
    if str(source) in SCENARIO_NAMES:
        return [ScenarioSpec.read(_PACKAGED / f"{source}.toml").of_file("")]
    path = Path(source)
    if str(source) and is_there(path) and path.is_dir():
        return _in_folder(path)
    if path.suffix in LOT_SUFFIXES and (path.suffix != ".json" or _is_geojson(path)):
        return [lot_scenario(path)]
    if str(source) and (path.suffix in (".toml", ".json") or is_there(path)):
        return [ScenarioSpec.read(path)]
    raise InputError(
        f"unknown scenario {str(source)!r}, and no such file; {nearest(str(source), SCENARIO_NAMES)}"
    )


def lot_scenario(lot: str | Path, source: str | None = None) -> ScenarioSpec:
    """Return the scenario of a lot alone: first goal, any entry, and a week fuller than nine in ten real car parks."""
    name = "".join(c if c.isprintable() and c not in "/\\," else " " for c in Path(lot).stem)[:80]
    tables = {"name": name, "lot": str(lot), "occupancy": {"real_week": {}, "day_error": DAY_ERROR}}
    return ScenarioSpec.parse(tables, str(lot) if source is None else source).of_file(lot)


def _in_folder(folder: Path) -> list[ScenarioSpec]:
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix in (".toml", ".geojson"))
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}") from error
    specs = {path: scenario_spec(path) for path in files if path.suffix == ".toml"}
    used = {spec.lot.file.resolve() for spec in specs.values() if spec.lot.file is not None}
    specs |= {path: lot_scenario(path) for path in files if path not in specs and path.resolve() not in used}
    if not specs:
        raise InputError(f"{folder}: holds no scenario (.toml) and no lot (.geojson)")
    return [specs[path] for path in files if path in specs]


def _is_geojson(path: Path) -> bool:
    return is_there(path) and read_tables(path).get("type") == "FeatureCollection"
