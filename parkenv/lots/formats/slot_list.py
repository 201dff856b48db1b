"""Lists of slots: a CSV file of slot centres, and the lot inferred from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.files.file_names import is_plain
from parkenv.files.limited_reading import csv_rows
from parkenv.lots.draft import ImportOptions, LotDraft, points_in_frame
from parkenv.lots.generators import KERB_SIZE, NO_SLOTS, Slots
from parkenv.lots.infer.layout import InferredLot, draft_inferred_lot, infer_lot
from parkenv.lots.infer.spaces import CenterRow, Spaces, describe_rows, spaces_from_centers
from parkenv.lots.local_frame import LocalFrame
from parkenv.world.lot import Mouth

COLUMNS = ("x", "y", "lat", "lon", "yaw", "id", "parking_cost_s", "zone")
SAME_PLACE = 0.1  # distance, m, within which two slot centres are one slot listed twice


@dataclass(frozen=True, eq=False)
class SlotList:
    """Slots given by their centres."""

    ids: tuple[str, ...]  # n_slots names
    xy: FloatArray  # (n_slots, 2) m
    yaw: FloatArray | None  # (n_slots,) rad, heading of a car parked nose-in; None without the column
    parking_cost_s: FloatArray  # (n_slots,) s, at least 0
    zone: NDArray[np.str_]  # (n_slots,) tariff zones; empty texts for none
    frame: LocalFrame | None  # geographic frame of the lot; None for a file in metres

    def subset(self, index: IntArray) -> SlotList:
        ids = tuple(self.ids[i] for i in index.tolist())
        yaw = None if self.yaw is None else self.yaw[index]
        return SlotList(ids, self.xy[index], yaw, self.parking_cost_s[index], self.zone[index], self.frame)


def read_slot_list(path: str | Path) -> SlotList:
    """Read a CSV file of slot centres.

    The first line names the columns: `x,y` in metres east and north, or `lat,lon` in degrees; optional are `yaw`,
    the heading in rad, counter-clockwise from east, of a car parked nose-in, `id` (by default the row number),
    `parking_cost_s`, the parking cost in seconds (by default 0), and `zone`, the tariff zone (by default none).
    """
    path = Path(path)
    rows = [row for _, row in csv_rows(path) if any(cell.strip() for cell in row)]
    head = [cell.strip().lower() for cell in rows[0]] if rows else []
    unknown = [name for name in head if name not in COLUMNS]
    pairs = [pair for pair in (("x", "y"), ("lat", "lon")) if set(pair) <= set(head)]
    if len(pairs) != 1 or unknown or len(set(head)) < len(head):
        raise InputError(
            f"{path}: columns are {','.join(head)!r:.80}, want x,y or lat,lon, and perhaps yaw, id, "
            "parking_cost_s and zone"
        )
    if len(rows) == 1:
        raise InputError(f"{path}: no slot below the line of columns")

    bounds = {"lat": 90.0, "lon": 180.0}
    values: dict[str, list[float]] = {name: [] for name in head if name not in ("id", "zone")}
    zones: list[str] = []
    ids: dict[str, int] = {}
    for number, row in enumerate(rows[1:], start=2):
        cells = dict(zip(head, (cell.strip() for cell in row), strict=True))
        name = cells.get("id", str(number))
        if not name or name in ids:
            where = f"appears already in row {ids[name]}" if name else "is empty"
            raise InputError(f"{path}: row {number}: id {name!r:.40} {where}")
        ids[name] = number
        zones.append(cells.get("zone", ""))
        if not is_plain(zones[-1]):
            raise InputError(f"{path}: row {number}: zone is {zones[-1]!a:.40}, want a name")
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
    return SlotList(names, points, yaw, cost, np.array(zones, np.str_), frame)


def _require_apart(path: Path, xy: FloatArray, ids: tuple[str, ...], rows: tuple[int, ...]) -> None:
    from scipy.spatial import cKDTree

    same = cKDTree(xy).query_pairs(SAME_PLACE, output_type="ndarray")
    if len(same):
        i, j = sorted(same[np.lexsort(np.sort(same, axis=1).T)[0]].tolist())
        raise InputError(
            f"{path}: row {rows[j]}: slot {ids[j]!r:.40} lies where slot {ids[i]!r:.40} of row {rows[i]} is"
        )


def slot_list_draft(path: str | Path, options: ImportOptions | None = None) -> LotDraft:
    """Draft a lot from a list of slots; where no lanes can be inferred it has their centres alone, and says why."""
    path = Path(path)
    options = options or ImportOptions()
    listed = read_slot_list(path)
    box = options.box(listed.frame)
    if box is not None:
        inside = np.asarray(((listed.xy >= box[:2]) & (listed.xy <= box[2:])).all(axis=1))
        if not inside.any():
            raise InputError(f"{path}: no slot within the bounds {', '.join(f'{b:g}' for b in box)} m")
        listed = listed.subset(np.flatnonzero(inside))
    entries, goals = (points_in_frame(listed.frame, given) for given in (options.entries, options.goals))
    rows: list[CenterRow] = []
    try:
        spaces, index, rows = spaces_from_centers(listed.ids, listed.xy, listed.yaw)
        lot = _infer_along_rows(spaces, entries)
        strays = np.setdiff1d(np.arange(len(listed.ids)), index)
        draft = draft_inferred_lot(
            path.stem,
            replace(lot, slots=_as_listed(lot.slots, index[lot.index], listed)),
            spaces,
            options,
            source="a list of slots",
            unit="centres",
            left_out={"slots in no row": [listed.ids[i] for i in strays]} if len(strays) else {},
            frame=listed.frame,
            goals=goals,
        )
    except InputError as error:
        draft = LotDraft(
            name=path.stem,
            slot_ids=(),
            slots=NO_SLOTS,
            slot_source=(),
            lanes=(),
            entries=entries,
            goals=goals,
            outlines=tuple(listed.xy[row.members[[0, -1]]] for row in rows),
            loose=listed.xy,
            missing=(f"no aisles: {error}",),
            frame=listed.frame,
        )
    found = [f"{len(listed.ids)} slot centres", *([describe_rows(rows)] if rows else [])]
    return replace(draft, found=(*found, *draft.found))


def _infer_along_rows(spaces: Spaces, entries: FloatArray) -> InferredLot:
    """Infer the lot with its rows along x: a list that is turned gives the same lot, turned."""
    double = np.exp(2j * np.arctan2(spaces.axis[:, 1], spaces.axis[:, 0])).mean()
    angle, middle = float(np.angle(double)) / 2, spaces.xy.mean(axis=0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def back(xy: FloatArray) -> FloatArray:
        return np.asarray(xy @ turn.T + middle)

    opens = None if spaces.opens is None else spaces.opens @ turn
    along = replace(spaces, xy=(spaces.xy - middle) @ turn, axis=spaces.axis @ turn, opens=opens)
    lot = infer_lot(along, entries=(entries - middle) @ turn)
    return replace(
        lot,
        slots=replace(lot.slots, xy=back(lot.slots.xy), yaw=lot.slots.yaw + angle),
        lanes=tuple(replace(lane, points=back(lane.points)) for lane in lot.lanes),
        entries=back(lot.entries),
        goal=back(lot.goal),
        entry=None if lot.entry is None else replace(lot.entry, points=back(lot.entry.points)),
    )


def _as_listed(slots: Slots, index: IntArray, listed: SlotList) -> Slots:
    """Return inferred slots with yaw, parking cost and zone of the list, kerbside ones with a car's usual length."""
    mouth = slots.mouth
    kerbside = mouth != Mouth.REAR
    yaw = slots.yaw if listed.yaw is None else listed.yaw[index]
    # A kerbside slot is inferred with its lane on the left; listed with the opposite yaw, it has it on the right.
    mouth = np.where(kerbside & (np.cos(yaw - slots.yaw) < 0.0), Mouth.RIGHT, mouth).astype(np.int8)
    length = np.where(kerbside, np.minimum(slots.length, KERB_SIZE[0]), slots.length)
    cost_s, zone = listed.parking_cost_s[index], listed.zone[index]
    return replace(slots, yaw=yaw, length=length, mouth=mouth, parking_cost_s=cost_s, zone=zone)
