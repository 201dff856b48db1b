"""Tables of results, for pages and terminals, from rows and declared columns."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from parkenv.files.known_names import UNBEATEN
from parkenv.show.columns import SHARED, Column
from parkenv.show.plurals import LEAST_SEARCHES, number_text

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

    Args:
        name: identifier of the table in the page.
        title: title above the table.
        rows: rows with mostly the same keys.
        columns: columns of the study, which replace and precede those of `SHARED`.
        facts: whether to show a single row from top to bottom.
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
