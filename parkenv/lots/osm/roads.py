"""Roads open to cars, from OpenStreetMap tags."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import ONE_WAY_HALF_WIDTH

STREET_WIDTH = {
    "motorway": 7.5,
    "trunk": 7.5,
    "primary": 7.0,
    "secondary": 7.0,
    "tertiary": 6.5,
    "unclassified": 6.0,
    "residential": 6.0,
    "road": 6.0,
    "living_street": 5.0,
    "service": 5.0,
}
"""Carriageway width, m, without parked cars, of two-way roads without the tags `width` and `lanes`."""
LIMITS = {
    **dict.fromkeys(("primary", "secondary", "tertiary", "unclassified", "road"), 50.0),
    "motorway": 100.0,
    "trunk": 70.0,
    "residential": 30.0,
    "living_street": 10.0,
    "service": 15.0,
}
"""Speed limit, km/h, of roads without the tag `maxspeed`, by class."""
_AISLE_LIMIT = 10.0  # km/h, of a `service=parking_aisle`
_NAMED_LIMITS = {"walk": 7.0, "none": 100.0, "urban": 50.0, "rural": 70.0, "living_street": 7.0}
AISLE_WIDTH = 6.0  # the same for a `service=parking_aisle`
LANE_WIDTH = 3.0  # width of each of the tagged `lanes`, m
NOT_FOR_PARKING = ("drive-through", "emergency_access", "bus")
"""Kinds of `highway=service` that are not lanes."""


class Rank(IntEnum):
    """Kind of road; a slot that faces several roads opens to the one of lowest rank."""

    AISLE = 0
    SERVICE = 1
    STREET = 2


@dataclass(frozen=True, eq=False)
class Road:
    """A way open to cars."""

    id: str  # such as `way/123`
    tags: Mapping[str, str]  # tags of the way
    points: FloatArray  # (k, 2) m, in the direction of traffic if one-way
    rank: Rank  # kind of road
    oneway: bool  # whether cars may drive only in the order of the points
    # whether the points are in reverse order of the way, which swaps its tags for left and right
    turned: bool

    @property
    def half_width(self) -> float:
        """Distance from the centre line to the edge of the carriageway without parked cars, m."""
        width = metres(self.tags.get("width"))
        if width is not None and not self.has_kerb_parking:
            return width / 2
        lanes = metres(self.tags.get("lanes"))
        if lanes is not None:
            return lanes * LANE_WIDTH / 2
        if self.rank is Rank.AISLE:
            return AISLE_WIDTH / 2
        if self.oneway:
            return ONE_WAY_HALF_WIDTH
        return STREET_WIDTH[self.tags["highway"].removesuffix("_link")] / 2

    @property
    def tagged_limit(self) -> float | None:
        """The speed limit that the tags say, km/h; None without one that can be read."""
        text = self.tags.get("maxspeed", "").strip()
        match = re.fullmatch(r"(\d{1,3})(?: ?(mph|km/h|kmh))?", text)
        if match is None:
            return _NAMED_LIMITS.get(text.rpartition(":")[2])
        return float(match[1]) * (1.609 if match[2] == "mph" else 1.0) or None

    @property
    def limit(self) -> float:
        """The speed limit, km/h: as tagged, else that of the class."""
        usual = (
            _AISLE_LIMIT if self.rank is Rank.AISLE else LIMITS[self.tags["highway"].removesuffix("_link")]
        )
        return self.tagged_limit or usual

    @property
    def has_kerb_parking(self) -> bool:
        """Whether parking along the road is tagged; `width` then includes parked cars."""
        return any(key.startswith("parking:") for key in self.tags)


def road_of(
    element_id: str, tags: Mapping[str, str], points: FloatArray, *, town: bool = False
) -> Road | str | None:
    """Create a road from a way; returns a reason if the road is left out, None if the way is not a road.

    Args:
        element_id: such as `way/123`.
        tags: tags of the way.
        points: (k, 2) m.
        town: whether all that cars drive on counts: motorways, tunnels, and private ways to private parking.
    """
    kind = tags.get("highway", "").removesuffix("_link")
    if kind not in STREET_WIDTH or tags.get("area") == "yes" or (kind == "motorway" and not town):
        return None
    service = tags.get("service")
    if kind == "service" and service in NOT_FOR_PARKING:
        return f"roads with service={service}"
    reason = closed_to_cars(tags)
    if town and kind == "service" and reason is not None and reason.endswith("=private"):
        reason = None
    if not town or kind == "service":
        reason = reason or off_the_ground(tags)
    if reason:
        return f"roads with {reason}"
    as_built = kind == "motorway" or tags.get("junction") in ("roundabout", "circular")
    oneway = tags.get("oneway", "yes" if as_built else "no")
    turned = oneway in ("-1", "reverse")
    step = np.diff(points, axis=0)
    points = points[np.r_[True, np.hypot(step[:, 0], step[:, 1]) > 0.01]]
    if len(points) < 2:
        return "roads without a length"
    rank = Rank.STREET
    if kind == "service":
        rank = Rank.AISLE if service == "parking_aisle" else Rank.SERVICE
    return Road(
        id=element_id,
        tags=tags,
        points=points[::-1] if turned else points,
        rank=rank,
        oneway=turned or oneway in ("yes", "true", "1"),
        turned=turned,
    )


def closed_to_cars(tags: Mapping[str, str]) -> str | None:
    """Return the tag that excludes cars (the most specific access tag decides), or None."""
    for key in ("motorcar", "motor_vehicle", "vehicle", "access"):
        if key in tags:
            return f"{key}={tags[key]}" if tags[key] in ("no", "private") else None
    return None


def off_the_ground(tags: Mapping[str, str]) -> str | None:
    """Return the tag that places an element underground or on a deck, or None."""
    if tags.get("tunnel", "no") not in ("no", "building_passage"):
        return f"tunnel={tags['tunnel']}"
    if tags.get("location") in ("underground", "indoor", "roof"):
        return f"location={tags['location']}"
    if tags.get("indoor", "no") != "no":
        return f"indoor={tags['indoor']}"
    if tags.get("level", "0") != "0":
        return f"level={tags['level']}"
    if tags.get("layer", "0").startswith("-"):
        return f"layer={tags['layer']}"
    return None


def metres(text: str | None) -> float | None:
    """Parse a length, m, such as `6` or `6.5 m`; None for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*m?\s*", text or "")
    value = float(match[1]) if match else 0.0
    return value if 0.0 < value < 100.0 else None


def whole_number(text: str | None) -> int | None:
    """Parse a count, also of texts such as `> 110`, `50+`, `ca. 60` and `1,500`; the middle of `20-30`.

    Returns None for anything else.
    """
    plain = re.sub(r"(?<=\d)[,. ](?=\d{3}(?!\d))", "", (text or "").strip())
    match = re.fullmatch(r"[^\d-]{0,5}(\d{1,5})(?:\s*[-–]\s*(\d{1,5}))?\D{0,10}", plain)
    return (int(match[1]) + int(match[2] or match[1])) // 2 if match else None
