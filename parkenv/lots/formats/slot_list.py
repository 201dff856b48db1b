"""Lists of slots: a CSV file of slot centres, and the lot inferred from it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError, naming, require
from parkenv.files.field_types import Name
from parkenv.files.limited_reading import csv_records
from parkenv.files.spec_file import Spec
from parkenv.lots.draft import ImportOptions, LotDraft, points_in_frame
from parkenv.lots.generators import KERB_SIZE, Slots
from parkenv.lots.infer.layout import InferredLot, draft_inferred_lot, infer_lot
from parkenv.lots.infer.spaces import Spaces, spaces_from_centers
from parkenv.lots.local_frame import LocalFrame
from parkenv.world.lot import Mouth

SAME_PLACE = 0.1  # distance, m, within which two slot centres are one slot listed twice


@dataclass(frozen=True, eq=False)
class SlotList:
    ids: tuple[str, ...]  # n_slots names
    xy: FloatArray  # (n_slots, 2) m
    yaw: FloatArray | None  # (n_slots,) rad, heading of a car parked nose-in; None without the column
    parking_cost_s: FloatArray  # (n_slots,) s, at least 0
    zone: NDArray[np.str_]  # (n_slots,) tariff zones; empty texts for none
    frame: LocalFrame | None  # geographic frame of the lot; None for a file in metres


Metres = Annotated[float, Field(ge=-1e8, le=1e8)]


class _Row(Spec):
    model_config = ConfigDict(strict=False, str_strip_whitespace=True)

    x: Metres | None = None
    y: Metres | None = None
    lat: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    lon: Annotated[float, Field(ge=-180.0, le=180.0)] | None = None
    yaw: Metres | None = None
    id: Annotated[str, Field(min_length=1)] | None = None
    parking_cost_s: Annotated[float, Field(ge=0.0, le=1e8)] = 0.0
    zone: Name = ""


def read_slot_list(path: str | Path) -> SlotList:
    """Read a CSV file of slot centres.

    The first line names the columns: `x,y` in metres east and north, or `lat,lon` in degrees; optional are `yaw`,
    the heading in rad, counter-clockwise from east, of a car parked nose-in, `id` (by default the row number),
    `parking_cost_s`, the parking cost in seconds (by default 0), and `zone`, the tariff zone (by default none).
    """
    path = Path(path)
    records = (record for _, record in csv_records(path) if any(text.strip() for text in record.values()))
    rows: dict[str, _Row] = {}
    for number, record in enumerate(records, start=2):
        with naming(f"{path}: row {number}"):
            row = _Row.parse({name.strip().lower(): text for name, text in record.items()}, "")
            name = row.id or str(number)
            if name in rows:
                raise InputError(f"id {name!r:.40} appears already in row {list(rows).index(name) + 2}")
            given = [column for column in ("x", "y", "lat", "lon") if getattr(row, column) is not None]
            if given not in (["x", "y"], ["lat", "lon"]):
                raise InputError(f"columns are {','.join(record)!r:.80}, want x,y or lat,lon")
        rows[name] = row
    require(rows, f"{path}: no slot below the line of columns")
    frame = None
    if row.lat is None:
        points = np.array([(row.x, row.y) for row in rows.values()], np.float64)
    else:
        lonlat = np.array([(row.lon, row.lat) for row in rows.values()], np.float64)
        frame = LocalFrame.around(lonlat)
        points = frame.to_xy(lonlat)
    same = cKDTree(points).query_pairs(SAME_PLACE, output_type="ndarray")
    if len(same):
        i, j = sorted(same[np.lexsort(np.sort(same, axis=1).T)[0]].tolist())
        names = list(rows)
        raise InputError(f"{path}: row {j + 2}: slot {names[j]!r:.40} lies where slot {names[i]!r:.40} is")
    yaw = None if row.yaw is None else np.array([row.yaw for row in rows.values()])
    cost = np.array([row.parking_cost_s for row in rows.values()])
    return SlotList(tuple(rows), points, yaw, cost, np.array([row.zone for row in rows.values()]), frame)


def slot_list_draft(path: str | Path, options: ImportOptions | None = None) -> LotDraft:
    """Draft a lot from a list of slots; its lanes are inferred from rows of rectangles."""
    path = Path(path)
    options = options or ImportOptions()
    listed = read_slot_list(path)
    box = options.box(listed.frame)
    if box is not None:
        inside = np.asarray(((listed.xy >= box[:2]) & (listed.xy <= box[2:])).all(axis=1))
        require(inside.any(), f"{path}: no slot within the bounds {', '.join(f'{b:g}' for b in box)} m")
        ids = tuple(name for name, is_inside in zip(listed.ids, inside.tolist(), strict=True) if is_inside)
        columns = ("xy", "yaw", "parking_cost_s", "zone")
        some = {name: values[inside] for name in columns if (values := getattr(listed, name)) is not None}
        listed = replace(listed, ids=ids, **some)
    entries, goals = (points_in_frame(listed.frame, given) for given in (options.entries, options.goals))
    with naming(path):
        spaces, index = spaces_from_centers(listed.ids, listed.xy, listed.yaw)
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
    return replace(draft, found=(f"{len(listed.ids)} slot centres", *draft.found))


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
