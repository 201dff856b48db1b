"""Lists of slots: a CSV file of slot centres, and the lot inferred from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.limited_reading import csv_rows
from parkenv.lots.draft import ImportOptions, LeftOut, LotDraft, points_in_frame
from parkenv.lots.importers.slot_layout import infer_layout
from parkenv.lots.importers.slot_rows import AmbiguousLayoutError
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.rows import NO_SLOTS

COLUMNS = ("x", "y", "lat", "lon", "yaw", "id", "parking_cost_s")
SAME_PLACE = 0.1  # distance, m, within which two slot centres are one slot listed twice


@dataclass(frozen=True, eq=False)
class SlotList:
    """Slots given by their centres."""

    ids: tuple[str, ...]  # n_slots names
    xy: FloatArray  # (n_slots, 2) m
    yaw: FloatArray | None  # (n_slots,) rad, heading of a car parked nose-in; None without the column
    parking_cost_s: FloatArray  # (n_slots,) s, at least 0
    frame: LocalFrame | None  # geographic frame of the lot; None for a file in metres


def read_slot_list(path: str | Path) -> SlotList:
    """Read a CSV file of slot centres.

    The first line names the columns: `x,y` in metres east and north, or `lat,lon` in degrees; optional are `yaw`,
    the heading in rad, counter-clockwise from east, of a car parked nose-in, `id` (by default the row number), and
    `parking_cost_s`, the parking cost in seconds (by default 0).

    Raises:
        InputError: the file cannot be read, a column is missing or unknown, a value is not a finite number or
            out of range, an id or a position appears twice.
    """
    path = Path(path)
    rows = [row for _, row in csv_rows(path) if any(cell.strip() for cell in row)]
    head = [cell.strip().lower() for cell in rows[0]] if rows else []
    unknown = [name for name in head if name not in COLUMNS]
    pairs = [pair for pair in (("x", "y"), ("lat", "lon")) if set(pair) <= set(head)]
    if len(pairs) != 1 or unknown or len(set(head)) < len(head):
        raise InputError(
            f"{path}: columns are {','.join(head)!r:.80}, want x,y or lat,lon, and perhaps yaw, id and parking_cost_s"
        )
    if len(rows) == 1:
        raise InputError(f"{path}: no slot below the line of columns")

    bounds = {"lat": 90.0, "lon": 180.0}
    values: dict[str, list[float]] = {name: [] for name in head if name != "id"}
    ids: dict[str, int] = {}
    for number, row in enumerate(rows[1:], start=2):
        cells = dict(zip(head, (cell.strip() for cell in row), strict=True))
        name = cells.get("id", str(number))
        if not name or name in ids:
            where = f"appears already in row {ids[name]}" if name else "is empty"
            raise InputError(f"{path}: row {number}: id {name!r:.40} {where}")
        ids[name] = number
        for column in values:
            try:
                value = float(cells[column])
            except ValueError:
                value = np.nan
            most = bounds.get(column, 1e8)
            least = 0.0 if column == "parking_cost_s" else -most
            if not least <= value <= most:
                raise InputError(
                    f"{path}: row {number}: {column} is {cells[column]!r:.40}, want a number from {least:g} to {most:g}"
                )
            values[column].append(value)
    points = np.column_stack([values[name] for name in pairs[0]])
    frame = None
    if pairs[0] == ("lat", "lon"):
        frame = LocalFrame.around(points[:, ::-1])
        points = frame.to_xy(points[:, ::-1])
    names = tuple(ids)
    _require_apart(path, points, names, tuple(ids.values()))
    yaw = np.array(values["yaw"]) if "yaw" in values else None
    cost = np.array(values.get("parking_cost_s", [0.0] * len(names)))
    return SlotList(names, points, yaw, cost, frame)


def _require_apart(path: Path, xy: FloatArray, ids: tuple[str, ...], rows: tuple[int, ...]) -> None:
    from scipy.spatial import cKDTree

    same = cKDTree(xy).query_pairs(SAME_PLACE, output_type="ndarray")
    if len(same):
        i, j = sorted(same[np.lexsort(np.sort(same, axis=1).T)[0]].tolist())
        raise InputError(
            f"{path}: row {rows[j]}: slot {ids[j]!r:.40} lies where slot {ids[i]!r:.40} of row {rows[i]} is"
        )


def slot_list_draft(path: str | Path, options: ImportOptions | None = None) -> LotDraft:
    """Draft a lot from a list of slots.

    See `parkenv.lots.importers.slot_layout` for the rules. If they are ambiguous, the draft has only slot centres and
    says so; it can still be drawn. A list has neither entries nor goals.

    Raises:
        InputError: see `read_slot_list`.
    """
    path = Path(path)
    options = options or ImportOptions()
    listed = read_slot_list(path)
    box = options.box(listed.frame)
    xy, ids, yaw, cost = listed.xy, listed.ids, listed.yaw, listed.parking_cost_s
    left_out: tuple[LeftOut, ...] = ()
    if box is not None:
        inside = np.asarray(((xy >= box[:2]) & (xy <= box[2:])).all(axis=1))
        if not inside.any():
            raise InputError(f"{path}: no slot within the bounds {', '.join(f'{b:g}' for b in box)} m")
        xy, yaw, cost = xy[inside], None if yaw is None else yaw[inside], cost[inside]
        ids = tuple(name for name, is_in in zip(ids, inside, strict=True) if is_in)
    how = "LAT,LON" if listed.frame else "X,Y"
    entries, goals = (
        points_in_frame(listed.frame, options.entries),
        points_in_frame(listed.frame, options.goals),
    )
    missing = []
    found = [f"{len(ids)} slot centres"]
    if listed.frame is not None:
        found.append(f"frame: metres east and north of {listed.frame.lat:.7f}, {listed.frame.lon:.7f}")
    try:
        layout = infer_layout(xy, yaw, ids)
    except AmbiguousLayoutError as error:
        return LotDraft(
            name=path.stem,
            slot_ids=(),
            slots=NO_SLOTS,
            slot_source=(),
            lanes=(),
            entries=entries,
            goals=goals,
            outlines=tuple(np.stack([row[0], row[-1]]) for row in error.rows),
            loose=xy,
            found=(*found, *error.found),
            missing=(f"no aisles: {error}",),
            frame=listed.frame,
        )
    if layout.strays:
        left_out = (LeftOut("slots in no row", tuple(ids[i] for i in layout.strays)),)
    if not len(entries):
        ends = [lane.points[i] for lane in layout.lanes for i in (0, -1)]
        if listed.frame is not None:
            ends = list(listed.frame.to_lonlat(ends)[:, ::-1])
        digits = 6 if listed.frame else 1
        shown = " or ".join(f"{a:.{digits}f},{b:.{digits}f}" for a, b in ends[:2])
        missing.append(f"no entry: a list of slots has none; give one by --entry {how}, e.g. {shown}")
    if not len(goals):
        missing.append(
            f"no goal: a list of slots has none; give the place that people walk to by --goal {how}"
        )
    return LotDraft(
        name=path.stem,
        slot_ids=tuple(ids[i] for i in layout.index),
        slots=replace(layout.slots, parking_cost_s=cost[list(layout.index)]),
        slot_source=("a list of slots",) * len(layout.index),
        lanes=layout.lanes,
        entries=entries,
        goals=goals,
        found=(*found, *layout.found),
        left_out=left_out,
        missing=tuple(missing),
        frame=listed.frame,
    ).searchable()
