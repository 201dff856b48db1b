"""Slots of a native lot file: validation, exact shapes, and shapes from polygons."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, nearest
from parkenv.files.file_names import is_plain
from parkenv.lots.formats.contents import LotContents, RawFeature, is_coordinate
from parkenv.lots.formats.geojson_supply import read_zone
from parkenv.lots.generators import Slots
from parkenv.lots.slot_polygons import slots_from_polygons
from parkenv.world.lot import SLOT_SIDE, Mouth

SLOT_SHAPE = ("center", "yaw", "length", "width", "mouth")  # the properties that define a slot exactly
MOUTHS = {mouth.name.lower(): mouth for mouth in Mouth}
SLOT_AGREEMENT = 0.01  # largest distance, m, between a slot's polygon and the rectangle of its properties


def read_slots(contents: LotContents, raw: list[RawFeature], xy: FloatArray, exact: bool) -> None:
    """Validate the slots of a file and add the valid ones.

    Exact properties are used only in a local frame: after a projection, stale ones would go unnoticed.
    """
    if not raw:
        return
    polygons = _polygons([xy[feature.parts[0]] for feature in raw])
    area = shapely.area(shapely.convex_hull(polygons))
    valid = shapely.is_valid(polygons)
    first_with: dict[str, int] = {}
    valid_rows: list[int] = []
    ids: list[str] = []
    shapes: list[tuple[float, ...] | None] = []
    costs: list[float] = []
    zones: list[str] = []
    facilities: list[str] = []
    drawn = dict.fromkeys(place.name for place in contents.facilities if not place.is_counted)
    first_with |= {
        facility.name: contents.numbers["facility"][i]
        for i, facility in enumerate(contents.facilities)
        if facility.is_counted
    }
    for i, feature in enumerate(raw):
        try:
            slot_id = _slot_id(feature)
            if slot_id in first_with:
                raise InputError(f"slot: id {slot_id!r:.40} appears already in feature {first_with[slot_id]}")
            first_with[slot_id] = feature.number
            if area[i] < SLOT_SIDE**2:
                raise InputError(f"slot {slot_id!r:.40}: the polygon is flat, want an area to park on")
            if not valid[i]:
                reason = shapely.is_valid_reason(polygons[i])
                raise InputError(f"slot {slot_id!r:.40}: the polygon is not a simple one: {reason}")
            cost = _parking_cost(feature.properties, slot_id)
            zone = read_zone(feature.properties, f"slot {slot_id!r:.40}", contents.zone_rules)
            facility = _facility(feature.properties, slot_id, drawn)
            shapes.append(_slot_shape(feature.properties, slot_id) if exact else None)
        except InputError as error:
            contents.error(feature.number, str(error))
            continue
        valid_rows.append(i)
        ids.append(slot_id)
        costs.append(cost)
        zones.append(zone)
        facilities.append(facility)

    polygons = polygons[valid_rows]
    bare = np.array([shape is None for shape in shapes], dtype=bool)
    slots = slots_from_polygons(polygons[bare], contents.lanes)
    if not bare.all():
        # x, y, yaw, length, width, mouth
        table = np.empty((len(valid_rows), 6))
        table[bare] = np.column_stack([slots.xy, slots.yaw, slots.length, slots.width, slots.mouth])
        table[~bare] = [shape for shape in shapes if shape is not None]
        slots = Slots(table[:, :2], table[:, 2], table[:, 3], table[:, 4], table[:, 5].astype(np.int8))

    apart = shapely.hausdorff_distance(polygons, slots.boxes())
    disagrees = ~bare & (apart > SLOT_AGREEMENT)
    thin = slots.width < SLOT_SIDE
    for k in np.flatnonzero(disagrees):
        contents.error(
            raw[valid_rows[k]].number,
            f"slot {ids[k]!r:.40}: the polygon lies {apart[k]:.2f} m from what center, yaw, length and width "
            f"say, want at most {SLOT_AGREEMENT:g} m",
        )
    for k in np.flatnonzero(thin):
        contents.error(
            raw[valid_rows[k]].number,
            f"slot {ids[k]!r:.40}: the polygon is {slots.width[k]:.3f} m wide, want at least {SLOT_SIDE:g} m",
        )
    kept = np.flatnonzero(~disagrees & ~thin)
    contents.slots = replace(
        slots,
        parking_cost_s=np.array(costs, np.float64),
        zone=np.array(zones, np.str_),
        facility=np.array(facilities, np.str_),
    )[kept]
    contents.slot_ids = [ids[k] for k in kept]
    contents.numbers["slot"] = [raw[valid_rows[k]].number for k in kept]


def _polygons(rings: Sequence[FloatArray]) -> NDArray[np.object_]:
    which = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    return np.asarray(shapely.polygons(shapely.linearrings(np.concatenate(rings), indices=which)))


def _slot_id(feature: RawFeature) -> str:
    given = feature.number if feature.given_id is None else feature.given_id
    if type(given) is int:
        return str(given)
    if not isinstance(given, str) or not given or not is_plain(given):
        raise InputError(f"slot: id is {given!r:.40}, want a text")
    return given


def _parking_cost(properties: dict[str, Any], slot_id: str) -> float:
    """Return the parking cost of a slot, s; 0 if not given."""
    cost = properties.get("parking_cost_s", 0.0)
    if not is_coordinate(cost) or cost < 0.0:
        raise InputError(f"slot {slot_id!r:.40}: parking_cost_s is {cost!r:.40}, want seconds, at least 0")
    return float(cost)


def _facility(properties: dict[str, Any], slot_id: str, drawn: Collection[str]) -> str:
    """Return the facility that a slot belongs to, one of those whose slots are drawn; empty text if not given."""
    facility = properties.get("facility", "")
    if not (isinstance(facility, str) and facility in drawn) and "facility" in properties:
        hint = nearest(str(facility), drawn)
        raise InputError(
            f"slot {slot_id!r:.40}: facility is {facility!r:.40}, want that of a feature without a capacity; {hint}"
        )
    return str(facility)


def _slot_shape(properties: dict[str, Any], slot_id: str) -> tuple[float, ...] | None:
    """Return exact x, y, yaw, length, width and mouth; None for a slot with only a polygon."""
    absent = [name for name in SLOT_SHAPE if name not in properties]
    if len(absent) == len(SLOT_SHAPE):
        return None
    if absent:
        raise InputError(f"slot {slot_id!r:.40}: no {absent[0]}, want all of {', '.join(SLOT_SHAPE)} or none")
    center, yaw, length, width, mouth = (properties[name] for name in SLOT_SHAPE)
    if not (isinstance(center, list) and len(center) == 2 and all(map(is_coordinate, center))):
        raise InputError(f"slot {slot_id!r:.40}: center is {center!r:.40}, want two finite numbers")
    if not is_coordinate(yaw):
        raise InputError(f"slot {slot_id!r:.40}: yaw is {yaw!r:.40}, want a finite number")
    for name, value in (("length", length), ("width", width)):
        if not is_coordinate(value) or value < SLOT_SIDE:
            raise InputError(f"slot {slot_id!r:.40}: {name} is {value!r:.40}, want at least {SLOT_SIDE:g} m")
    if not isinstance(mouth, str) or mouth not in MOUTHS:
        raise InputError(f"slot {slot_id!r:.40}: mouth is {mouth!r:.40}, want one of {', '.join(MOUTHS)}")
    return (*center, yaw, length, width, MOUTHS[mouth])
