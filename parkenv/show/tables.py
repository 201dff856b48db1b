"""Tables of results, for pages and terminals: declared columns, numbers in words, rows as cells."""

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

from parkenv.files.known_names import UNBEATEN
from parkenv.world.cost_terms import COST_TERMS

LEAST_SEARCHES = 5  # searches below which no interval is shown: a bootstrap of fewer covers less than 95 %


def plural(number: int, noun: str, several: str | None = None) -> str:
    """Return a number with its noun, in the singular for 1.

    Examples:
        >>> plural(1, "episode"), plural(20, "episode"), plural(2, "search", "searches")
        ('1 episode', '20 episodes', '2 searches')
    """
    return f"{number} {noun if number == 1 else several or f'{noun}s'}"


def number_text(value: float, spec: str) -> str:
    """Format a number; one that is rounded to zero has no sign.

    Examples:
        >>> number_text(-0.04, "+.1f"), number_text(0.06, "+.1f")
        ('0.0', '+0.1')
    """
    return re.sub(r"^[+-](?=[0.]*%?$)", "", format(value, spec))


def interval_text(value: float, ends: tuple[float, float] | list[float] | None, spec: str) -> str:
    """Format a value and its interval, if there is one.

    Examples:
        >>> interval_text(0.0, (-1.0, 0.0), "+.1f"), interval_text(2.0, (float("nan"),) * 2, ".0f")
        ('0.0 [-1.0, 0.0]', '2')
    """
    if ends is None or ends[0] != ends[0]:
        return number_text(value, spec)
    return f"{number_text(value, spec)} [{', '.join(number_text(end, spec) for end in ends)}]"


def slots_text(right: float, unknown: float) -> str:
    return f"{right:.1%} right, {unknown:.1%} unknown, {max(1.0 - right - unknown, 0.0):.1%} wrong"


SETTING_AXES = ("failure_cost_s", "v_walk_kmh", "v_drive_kmh")  # columns of a setting of costs and speeds


class Column(NamedTuple):
    key: str  # in the summary
    label: str  # heading
    unit: str = ""  # of the numbers; empty for none
    digits: int = 1  # number of decimals
    share: bool = False  # whether the value is a fraction, shown as a percentage
    signed: bool = False  # whether positive values get a plus sign
    help: str = ""  # explanation
    given: bool = False  # whether the numbers were chosen, and keep all their digits
    setting: bool = (
        False  # whether it stands above the table if it is equal in all rows, as measures never do
    )
    needs: str = ""  # column that must differ from 0 in some row for this one to be shown


# Columns of searches, in the order of tables.
SHARED = (
    Column("scenario", "scenario", setting=True),
    Column("blind", "blind", help="Whether no slot is observed before an attempt", setting=True),
    Column("occupancy_level", "occupancy level", share=True, digits=0, help="Mean occupancy the lot was set to",
           setting=True),
    Column("failure_cost_s", "failure cost", "s", 0, help="Time of a failed parking attempt", given=True, setting=True),
    Column("v_walk_kmh", "walking speed", "km/h", 0, given=True, setting=True),
    Column("v_drive_kmh", "driving speed", "km/h", 0, given=True, setting=True),
    Column("agent", "agent"),
    Column("total_s", "total time", "s", help=" + ".join(term.label for term in COST_TERMS).capitalize()),
    Column("median_s", "median time", "s", help="Median of the total times", needs="gave_up_fraction"),
    Column("gave_up_fraction", "found no slot", share=True, help="Searches that gave up; charged the penalty",
           needs="gave_up_fraction"),
    Column("difference_s", "change from the first agent", "s", signed=True, help="Paired by world; 95 % interval"),
    Column("gap_to_bound", "above the best possible, at most", share=True, digits=1),
    Column("regret_s", "regret (above the bound)", "s", help="Difference to the clairvoyant lower bound"),
    *(
        Column(term.field, f"time: {term.label}", "s", help=term.help, needs=term.field if term.optional else "")
        for term in COST_TERMS
    ),
    Column("parked_fraction", "parked", share=True, digits=0),
    Column("episodes", "searches", digits=0, setting=True),
    Column("failed_parks", "failed attempts, number", digits=2),
    Column("replans", "replans", help="How often the agent replanned in a search"),
    Column("driven_m", "distance driven", "m"),
    Column("walked_m", "distance walked", "m"),
    Column("slots_passed", "slots passed"),
    Column("occupancy", "slots taken at arrival", share=True, digits=0),
    Column("bound_s", "lower bound", "s", help="Least time if the whole future were known"),
    Column("decision_ms", "a decision takes", "ms", 2, help="Median wall time of a decision"),
    Column("decision_ms_p99", "99 % of decisions below", "ms", 2, help="99th percentile of their wall times"),
)  # fmt: skip


def shared(*keys: str) -> tuple[Column, ...]:
    return tuple(column for column in SHARED if column.key in keys)


Row = Mapping[str, Any]
Cell = float | int | str | bool | None | list[float | None]
_TABLES_OF_THEIR_OWN = ("by_weather",)
_UNITS = {"_kmh": "km/h", "_ms": "ms", "_s": "s", "_m": "m", "_deg": "°", "_rad": "rad"}


def undeclared(key: str) -> Column:
    """Return the format of a column that is labelled by its key.

    Examples:
        >>> undeclared("brake_distance_m")[:3]
        ('brake_distance_m', 'brake distance', 'm')
    """
    ending = next((ending for ending in _UNITS if key.endswith(ending)), "")
    label = key.removesuffix(ending).replace("_", " ").replace(".", ", ")
    return Column(key, label, _UNITS.get(ending, ""), 3)


def table_of(
    name: str, title: str, rows: Sequence[Row], columns: Sequence[Column] = (), *, facts: bool = False
) -> dict[str, Any]:
    """Build a table of the page's data.

    Columns stand in the order in which they are declared, then in that of the rows. Intervals (`NAME_ci95`) are merged
    into the column of their value. Settings that are equal in all rows go to `same`, which is printed above the table.
    `leads` holds the numbers of the rows whose agent leads, `unbeaten` those of `UNBEATEN`.

    The study's `columns` replace and precede those of `SHARED`; `facts` shows a single row from top to bottom. Pages
    know the table by its `name`.
    """
    flat = [_flat(row) for row in rows]
    present = {key: None for row in flat for key in row if key != "leads"}
    declared = {column.key: column for column in (*columns, *SHARED)} | {c.key: c for c in columns}
    keys = [key for key in declared if key in present] + [key for key in present if key not in declared]
    shown, same = list[Column](), list[tuple[Column, Cell]]()
    for column in (declared.get(key) or undeclared(key) for key in keys):
        values = [row.get(column.key) for row in flat]
        if column.needs and not any(_first(row.get(column.needs, 1.0)) for row in flat):
            continue
        is_same = len(rows) > 1 and len(set(map(repr, values))) == 1
        if is_same and values[0] is not None and column.setting:
            same.append((column, values[0]))
        elif not is_same or values[0] is not None:
            shown.append(column)
    return {
        "name": name,
        "title": title,
        "facts": facts,
        "columns": [described(column) for column in shown],
        "rows": [[row.get(column.key) for column in shown] for row in flat],
        "leads": [i for i, row in enumerate(flat) if row.get("leads")],
        "unbeaten": [i for i, row in enumerate(flat) if row.get("agent") in UNBEATEN],
        "same": [{**described(column), "value": value} for column, value in same],
    }


def tables_of(
    summary: Mapping[str, Any], titles: Mapping[str, str], columns: Sequence[Column] = ()
) -> list[dict[str, Any]]:
    """Build the tables of a command's summary: of its entry `rows`, and of others unless they are empty."""
    return [
        table_of(name, title, summary[name], columns)
        for name, title in titles.items()
        if name == "rows" or summary.get(name)
    ]


def spread(rows: Sequence[Row], names: Sequence[str], over: str, value: str) -> list[dict[str, Any]]:
    """Return a row for each combination of `names`, with a column of `value` for each value of `over`."""
    wide: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        key = tuple(row[name] for name in names)
        wide.setdefault(key, dict(zip(names, key, strict=True)))[str(row[over])] = row[value]
    return [*wide.values()]


def part_of(table: Mapping[str, Any], keys: Collection[str]) -> dict[str, Any]:
    chosen = [i for i, column in enumerate(table["columns"]) if column["key"] in keys]
    return {
        **table,
        "columns": [table["columns"][i] for i in chosen],
        "rows": [[row[i] for i in chosen] for row in table["rows"]],
        "same": [column for column in table["same"] if column["key"] in keys],
    }


def described(column: Column) -> dict[str, Any]:
    left_out = ("setting", "needs")
    return {k: v for k, v in column._asdict().items() if v != "" and v is not False and k not in left_out}


def written(column: Mapping[str, Any], value: Cell) -> str:
    """Return a value of a table, or a value and its interval, as text; nothing for what is not known.

    Examples:
        >>> written(described(Column("change_s", "change", "s", signed=True)), [-1.25, -2.0, 0.04])
        '-1.2 [-2.0, 0.0]'
    """
    if isinstance(value, list):
        mean, *ends = (written(column, part) for part in value)
        return f"{mean} [{', '.join(ends)}]" if all(ends) else mean
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str) or value is None or value != value:
        return value if isinstance(value, str) else ""
    if column.get("given"):
        return f"{value:g}"
    number = 100.0 * value if column.get("share") else value
    digits = 0 if isinstance(value, int) or abs(number) >= 1000.0 else column["digits"]
    text = number_text(number, f"{'+' if column.get('signed') else ''},.{digits}f")
    return f"{text}%" if column.get("share") else text


def _first(cell: Cell) -> Cell:
    return cell[0] if isinstance(cell, list) else cell


def _flat(row: Row, prefix: str = "") -> dict[str, Cell]:
    flat: dict[str, Cell] = {}
    for key, value in row.items():
        name = prefix + key
        if isinstance(value, Mapping):
            if key not in _TABLES_OF_THEIR_OWN:
                flat |= _flat(value, f"{name}.")
        elif key.endswith("_ci95"):
            base = name.removesuffix("_ci95")
            if row.get("episodes", LEAST_SEARCHES) < LEAST_SEARCHES:
                value = [None, None]
            known = flat.get(base) is not None or value != [None, None]
            flat[base] = [flat.get(base), *value] if known else None  # type: ignore[list-item]
        elif isinstance(value, (list, tuple)):
            if len(value) == 2 and not any(isinstance(v, (Mapping, list)) for v in value):
                flat[name] = f"{value[0]:g} to {value[1]:g}"
        else:
            flat[name] = value
    return flat
