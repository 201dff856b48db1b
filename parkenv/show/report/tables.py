"""Tables of results, for pages and terminals: their columns, labels and number formats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from parkenv.files.known_names import UNBEATEN
from parkenv.show.columns import SETTING_AXES
from parkenv.show.plurals import LEAST_SEARCHES, number_text
from parkenv.world.cost_terms import COST_FIELDS, COST_TERMS

Row = Mapping[str, Any]
Cell = float | int | str | bool | None | list[float | None]


class Column(NamedTuple):
    """Format of a column.

    Attributes:
        key: key in the summary.
        label: heading.
        unit: unit of the numbers; empty for none.
        digits: number of decimals.
        share: whether the value is a fraction, shown as a percentage.
        signed: whether positive values get a plus sign.
        help: explanation.
    """

    key: str
    label: str
    unit: str = ""
    digits: int = 1
    share: bool = False
    signed: bool = False
    help: str = ""


_GIVEN = (*SETTING_AXES, "arrivals_per_hour")
"""Columns of numbers that somebody chose, which have all their digits."""
_OPTIONAL = tuple(term.field for term in COST_TERMS if term.optional)
_MINUS_OWN = "total time, minus that of all cars with own observations only, on the same days"
_METHODS = (
    ("fitted", "rectangle fitted to the beams"), ("thesis", "middle of the beams, as in the thesis")
)  # fmt: skip
_CAR_ERRORS = (
    Column("range_error_m", "distance, median error", "m", 3),
    Column("range_error_p95_m", "distance, 95th percentile", "m", 2),
    Column("place_error_m", "position, median error", "m", 2),
    Column("heading_error_deg", "heading, median error", "°", 1),
)
_PAIRED = "After minus before, of the same cars on the same days"
_KNOWN = {
    column.key: column
    for column in (
        Column("scenario", "scenario"),
        Column("test_scenario", "tested on"),
        Column("blind", "blind", help="Whether no slot is observed before an attempt"),
        Column("occupancy_level", "occupancy level", share=True, digits=0, help="Mean occupancy the lot was set to"),
        Column("agent", "agent"),
        Column("map", "map at first", help="fixed: right, does not learn; none: the agent uses no map"),
        Column("day", "day", digits=0),
        Column("days", "days", digits=0),
        Column("courses", "drivers", digits=0),
        Column("forecast_error", "forecast error", digits=3, help="Brier score of P(taken) at the arrival"),
        Column("failure_cost_s", "failure cost", "s", 0, help="Time of a failed parking attempt"),
        Column("v_walk_kmh", "walking speed", "km/h", 0),
        Column("v_drive_kmh", "driving speed", "km/h", 0),
        Column("episodes", "searches", digits=0),
        Column("seed", "seed", digits=0),
        Column("total_s", "total time", "s", help=" + ".join(term.label for term in COST_TERMS).capitalize()),
        Column("difference_s", "change from the first agent", "s", signed=True, help="Paired by world; 95 % interval"),
        Column("regret_s", "regret (above the bound)", "s", help="Difference to the clairvoyant lower bound"),
        *(Column(term.field, f"time: {term.label}", "s", help=term.help) for term in COST_TERMS),
        Column("bound_s", "lower bound", "s", help="Least time if the whole future were known"),
        Column("parked_fraction", "parked", share=True, digits=0),
        Column("failed_parks", "failed attempts, number", digits=2),
        Column("replans", "replans", help="How often the agent replanned in a search"),
        Column("driven_m", "distance driven", "m"),
        Column("walked_m", "distance walked", "m"),
        Column("slots_passed", "slots passed"),
        Column("occupancy", "slots taken at arrival", share=True, digits=0),
        Column("decision_ms", "a decision takes", "ms", 2, help="Median wall time of a decision"),
        Column("decision_ms_p99", "99 % of decisions below", "ms", 2, help="99th percentile of their wall times"),
        Column("gap_to_exact", "above the optimum", share=True, digits=2, signed=True),
        Column("gap_to_bound", "above the best possible, at most", share=True, digits=1),
        Column("steps", "decisions in training", digits=0),
        Column("steps_per_s", "decisions/s", digits=0),
        Column("model", "model"),
        Column("task", "task"),
        Column("score", "score", share=True, help="Mean time of the clairvoyant bound over the agent's"),
        Column("by", "submitted by"),
        Column("parkenv", "parkenv", help="Version that made the result"),
        Column("sessions", "drives", digits=0),
        Column("slots", "slots", digits=0),
        Column("car_detection_rate", "parked cars found", share=True, help="Detected at least once"),
        Column("detection_precision", "detections that are cars", share=True),
        Column("range_abs_error_m.median", "distance of a car, median error", "m", 3),
        Column("range_abs_error_m.p95", "distance of a car, 95th percentile", "m", 2),
        *_CAR_ERRORS,
        *(
            column._replace(key=f"car_pose.{key}.{column.key}", label=f"{name}: {column.label}")
            for key, name in _METHODS
            for column in _CAR_ERRORS
        ),
        Column("localise", "localisation"),
        Column("pose_error_m.odometry", "position by odometry, error", "m", 2, help="Root mean square, of a drive"),
        Column("pose_error_m.estimated", "position as estimated, error", "m", 2),
        Column("pose_error_m.max", "position as estimated, greatest error", "m", 2),
        Column("slot_accuracy", "slot accuracy", share=True, help="Slots never in view count as wrong"),
        Column("slot_accuracy_seen", "slot accuracy, slots in view", share=True),
        Column("unknown_fraction", "slots never in view", share=True),
        Column("occupancy_mae", "map error", digits=3, help="Mean absolute error of P(taken)"),
        Column("occupancy_mae_expected", "map error of raw counts", digits=3, help="Of as many drives at that hour"),
        Column("seconds_per_frame", "perception time per frame", "s", 3),
        Column("slots_found.precision", "discovered slots, precision", share=True),
        Column("slots_found.recall", "discovered slots, recall", share=True),
        Column("slots_found.error", "discovered slots, mean position error", "m", 2),
        Column("slots_found.yaw_error", "discovered slots, mean heading error", "rad", 3),
        Column("distance_m", "distance", "m", 0),
        Column("rate", "share detected", share=True, help="In frames in which the car is not occluded"),
        Column("in_frame", "cars in frames", digits=0),
        Column("detected", "detected", digits=0),
        Column("success", "successful parkings", share=True),
        Column("parked", "parked", digits=0),
        Column("found", "found", digits=0),
        Column("detections", "detections", digits=0),
        Column("right", "correct", digits=0),
        Column("occupied_fraction", "slots taken", share=True, digits=0),
        Column("case", "case"),
        Column("clearance_m", "smallest clearance", "m", 3),
        Column("error_m", "error at the end", "m", 3),
        Column("error_rad", "error at the end", "rad", 4),
        Column("length_m", "distance driven", "m"),
        Column("direction_changes", "changes of direction", digits=0),
        Column("planning_s", "planning", "s", 3),
        Column("agents", "agents"),
        Column("knows", "members know"),
        Column("share", "members", share=True, digits=0),
        Column("arrivals_per_hour", "cars an hour", digits=0),
        Column("hour", "hour", digits=0, help="Of the day: 8 is from 8:00 to 9:00"),
        Column("counted_occupancy", "as counted", share=True, digits=0, help="By the world's counts, log or process"),
        Column("excess", "minus counted", share=True, signed=True, help="Simulated minus counted occupancy"),
        Column("cars", "cars", digits=0),
        Column("median_s", "median time", "s", help="Median of the total times"),
        Column("gave_up_fraction", "found no slot", share=True, help="Searches that gave up; charged the penalty"),
        Column("p95_s", "95 % of cars below", "s", 0, help="95 % quantile of the total times of a day's cars"),
        Column("gini", "inequality (Gini)", digits=3, help="Inequality of total times: 0 if all are equal"),
        Column("search_s", "search time", "s", help="From the entry to the end of the search"),
        Column("queued_s", "time in queues", "s", help="Behind cars that park, leave or stand; in the search time"),
        Column("failed_attempts", "failed attempts a car", digits=3),
        Column("cruised_m", "detour driven", "m", 0, help="Drive beyond the shortest drive to the slot"),
        Column("cruising_share", "traffic that cruises", share=True, digits=0, help="Detours in all metres driven"),
        Column("balked_fraction", "found no slot", share=True),
        Column("members_s", "time of members", "s", help="Total time of members"),
        Column("others_s", "time of the others", "s", help="Total time of non-members"),
        Column("members_difference_s", "change by guidance, members", "s", signed=True, help=f"Members' {_MINUS_OWN}"),
        Column("others_difference_s", "change by guidance, others", "s", signed=True, help=f"The others' {_MINUS_OWN}"),
        Column("price_of_anarchy", "price of anarchy", digits=3, help="Total time over that with reservations for all"),
        Column("clairvoyant_s", "clairvoyant bound", "s", help="Lower bound that knows all arrivals and stays"),
        Column("price_over_bound", "price over the bound", digits=3, help="Total time over the clairvoyant bound"),
        Column("before", "instead of"),
        Column("prices", "prices"),
        Column("block", "block", help="A facility, or the slots of a zone that belong to none"),
        Column("type", "type"),
        Column("purpose", "purpose"),
        Column("refused_a_day", "refused a day", digits=0, help="Failed attempts: taken, or full"),
        Column("zone", "zone", help="Of changes: where the cars parked before; – for all cars"),
        Column("cars_a_day", "cars a day", digits=0),
        Column("paid", "paid a car", digits=2, help="In the currency of the prices; mean over all cars"),
        Column("paying_share", "cars that pay", share=True, digits=0),
        Column("price", "price an hour", digits=2, help="In the currency of the prices, as all that is paid"),
        Column("parked_a_day", "cars a day", digits=0, help="Cars that park in the zone"),
        Column("share_parked", "of all cars", share=True, digits=0, help="Of the cars that park"),
        Column("paid_a_day", "paid a day", digits=2, help="Revenue: the stays of a day's cars, each paid in full"),
        Column("paid_a_car", "paid a car", digits=2, help="Of those that park in the zone"),
        Column("change_s", "change, all cars", "s", signed=True, help=_PAIRED),
        Column("members_change_s", "change, members", "s", signed=True, help=f"{_PAIRED}: members after the change"),
        Column("others_change_s", "change, the others", "s", signed=True, help=_PAIRED),
        Column("search_change_s", "change, search time", "s", signed=True, help=_PAIRED),
        Column("parking_cost_change_s", "change, parking cost", "s", signed=True, help=f"{_PAIRED}; prices as time"),
        Column("gave_up_change_s", "change, give-up penalty", "s", signed=True, help=_PAIRED),
        Column("balked_change", "change, found no slot", share=True, signed=True, help=_PAIRED),
        Column("paid_change", "change, paid a car", digits=2, signed=True, help=f"{_PAIRED}; in the prices' currency"),
        Column("better_off", "better off", share=True, digits=0, help="Cars that gain at least a second"),
        Column("worse_off", "worse off", share=True, digits=0, help="Cars that lose at least a second"),
        Column("chance", "chance in the days", share=True, digits=0),
        Column("of_zones", "curve, day means", share=True, digits=0),
        Column("measured", "mean measured"),
        Column("bias", "curve, bias", share=True, signed=True),
        Column("key", "drive"),
        Column("weather", "weather"),
        Column("rig", "rig"),
    )
}  # fmt: skip
_ORDER = (
    "scenario", "blind", "map", "task", "test_scenario", "occupancy_level", "failure_cost_s", "v_walk_kmh",
    "v_drive_kmh", "after", "before", "prices", "purpose", "block", "type", "zone",
    "agent", "agents", "arrivals_per_hour", "knows", "share",
    "hour", "seed",
    "change_s", "members_change_s", "others_change_s", "paid_change", "better_off", "worse_off", "total_s", "median_s",
    "gave_up_fraction", "difference_s", "gap_to_exact", "gap_to_bound",
    "price_of_anarchy", "price_over_bound", "search_s", "regret_s", *COST_FIELDS, "parked_fraction",
)  # fmt: skip
"""The first columns, in this order."""
OF_FLEETS = {
    column.key: column for column in (
        Column("difference_s", "change by guidance, all cars", "s", signed=True, help=f"Mean {_MINUS_OWN}"),
        Column("median_s", "median time", "s", help="Median of the total times of a day's cars"),
        Column("bound_s", "time if alone", "s", help="Mean total time of a car alone in an empty lot that it knows"),
        Column("occupancy", "slots taken", share=True, digits=0, help="Mean share of slots taken while cars arrive"),
    )
}  # fmt: skip
"""Columns that mean something else in the table of `parkenv fleet`."""
_OF_GIVING_UP = ("median_s", "gave_up_fraction")
"""Columns that are left out where no search gave up."""
_OF_MEMBERS = (
    "knows", "share", "members_s", "others_s", "difference_s", "members_difference_s", "others_difference_s",
    "members_change_s", "others_change_s",
)  # fmt: skip
"""Columns that are left out where there are no members."""
_PARTS = ("parking_cost_change_s", "gave_up_change_s")
"""Columns that are left out where they are 0 or unknown."""
_NOTHING = {repr(value) for value in (None, [0.0] * 3, [0.0, None, None])}
_TABLES_OF_THEIR_OWN = ("by_weather",)
_UNITS = (("_kmh", "km/h"), ("_ms", "ms"), ("_s", "s"), ("_m", "m"), ("_deg", "°"), ("_rad", "rad"))


def column_of(key: str) -> Column:
    """Return the format of a column; unknown columns are labelled by their key.

    Examples:
        >>> column_of("total_s").label, column_of("brake_distance_m")[:3]
        ('total time', ('brake_distance_m', 'brake distance', 'm'))
    """
    if key in _KNOWN:
        return _KNOWN[key]
    for ending, unit in _UNITS:
        if key.endswith(ending):
            return Column(key, key.removesuffix(ending).replace("_", " ").replace(".", ", "), unit, 3)
    return Column(key, key.replace("_", " ").replace(".", ", "), digits=3)


def table_of(
    name: str,
    title: str,
    rows: Sequence[Row],
    *,
    facts: bool = False,
    columns: Mapping[str, Column] = MappingProxyType({}),
) -> dict[str, Any]:
    """Build a table of the page's data.

    Intervals (`NAME_ci95`) are merged into the column of their value. Columns that are equal in all rows go to `same`,
    which is printed above the table. `leads` holds the numbers of the rows whose agent leads, `unbeaten` those of
    `UNBEATEN`.

    Args:
        name: identifier of the table in the page.
        title: title above the table.
        rows: rows with mostly the same keys.
        facts: whether to show a single row from top to bottom.
        columns: formats of columns that differ from `column_of`.
    """

    def written(key: str) -> dict[str, Any]:
        return described(columns.get(key) or column_of(key))

    flat = [_flat(row) for row in rows]
    keys = list(dict.fromkeys(key for row in flat for key in row))
    keys = [k for k in _ORDER if k in keys] + [k for k in keys if k not in _ORDER and k != "leads"]
    if not any(row.get("gave_up_fraction", 1.0) for row in flat):
        keys = [k for k in keys if k not in _OF_GIVING_UP]
    if not any(row.get("share", 1.0) for row in flat):
        keys = [k for k in keys if k not in _OF_MEMBERS]
    values = {key: [row.get(key) for row in flat] for key in keys}
    keys = [k for k in keys if k not in _PARTS or set(map(repr, values[k])) - _NOTHING]
    same = []
    if len(rows) > 1:
        same = [k for k in keys if len({repr(v) for v in values[k]}) == 1]
        # Compared values stay in the table even if they are equal.
        same = [
            k
            for k in same
            if values[k][0] is None
            or k in _ORDER[:9]
            or k in ("agents", "change", "days", "episodes", "rig", "slots")
            # Parts of a sum stay beside it, unless they add nothing.
            or (k in _OPTIONAL and not values[k][0])
        ]
    shown = [k for k in keys if k not in same]
    return {
        "name": name,
        "title": title,
        "facts": facts,
        "columns": [written(key) for key in shown],
        "rows": [[values[key][i] for key in shown] for i in range(len(rows))],
        "leads": [i for i, row in enumerate(flat) if row.get("leads")],
        "unbeaten": [i for i, row in enumerate(flat) if row.get("agent") in UNBEATEN],
        "same": [{**written(key), "value": values[key][0]} for key in same if values[key][0] is not None],
    }


def described(column: Column) -> dict[str, Any]:
    """Return a column for the page's data, without empty entries."""
    return {k: v for k, v in column._asdict().items() if v != "" and v is not False}


def written(column: Mapping[str, Any], value: Cell) -> str:
    """Return a value of a table, or a value and its interval, as text; nothing for what is not known.

    Examples:
        >>> written(described(column_of("difference_s")), [-1.25, -2.0, 0.04])
        '-1.2 [-2.0, 0.0]'
    """
    if isinstance(value, list):
        mean, *ends = (written(column, part) for part in value)
        return f"{mean} [{', '.join(ends)}]" if all(ends) else mean
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str) or value is None or value != value:
        return value if isinstance(value, str) else ""
    if column["key"] in _GIVEN:
        return f"{value:g}"
    number = 100.0 * value if column.get("share") else value
    digits = 0 if isinstance(value, int) or abs(number) >= 1000.0 else column["digits"]
    text = number_text(number, f"{'+' if column.get('signed') else ''},.{digits}f")
    return f"{text}%" if column.get("share") else text


def _flat(row: Mapping[str, Any], prefix: str = "") -> dict[str, Cell]:
    """Flatten nested keys and merge intervals; skip lists of rows, which have their own tables."""
    made: dict[str, Cell] = {}
    for key, value in row.items():
        name = prefix + key
        if isinstance(value, Mapping):
            if key not in _TABLES_OF_THEIR_OWN:
                made |= _flat(value, f"{name}.")
        elif key.endswith("_ci95"):
            base = name.removesuffix("_ci95")
            if row.get("episodes", LEAST_SEARCHES) < LEAST_SEARCHES:
                value = [None, None]
            known = made.get(base) is not None or value != [None, None]
            made[base] = [made.get(base), *value] if known else None  # type: ignore[list-item]
        elif isinstance(value, (list, tuple)):
            if len(value) == 2 and not any(isinstance(v, (Mapping, list)) for v in value):
                made[name] = f"{value[0]:g} to {value[1]:g}"
        else:
            made[name] = value
    return made


def tables_of(
    summary: Mapping[str, Any],
    titles: Mapping[str, str],
    columns: Mapping[str, Column] = MappingProxyType({}),
) -> list[dict[str, Any]]:
    """Build the tables of a command's summary: of its entry `rows`, and of others unless they are empty."""
    return [
        table_of(name, title, summary[name], columns=columns)
        for name, title in titles.items()
        if name == "rows" or summary.get(name)
    ]


def survey_tables(surveyed: Row, sessions: Sequence[Row]) -> list[dict[str, Any]]:
    """Build the tables of a survey."""
    tables = [table_of("survey", "The survey", [surveyed], facts=True)]
    if by_weather := surveyed.get("by_weather"):
        its = [{"weather": _plain(w), **row} for w, row in by_weather.items()]
        tables.append(table_of("by_weather", "By weather", its))
    if found := surveyed.get("detection_by_distance"):
        its = [{**row, "weather": _plain(row["weather"])} for row in found]
        tables.append(table_of("detection_by_distance", "Detection rate by distance", its))
    if sessions:
        its = [{c: _plain(row[c]) if c == "weather" else row[c] for c in _SESSION} for row in sessions]
        tables.append(table_of("sessions", "Survey drives", its))
    return tables


_SESSION = (
    "key", "weather", "occupied_fraction", "parked", "found", "detections", "right", "slot_accuracy",
    "slot_accuracy_seen", "unknown_fraction", "place_error_m", "heading_error_deg", "seconds_per_frame",
)  # fmt: skip


def _plain(word: Any) -> str:
    return str(word).replace("_", " ")
