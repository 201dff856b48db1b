"""How many cars fit into a car park or a garage: as tagged, else by its area and its levels."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple


class AreaRule(NamedTuple):
    """Places by area: `places_of_square_metre` · (area · levels) ^ `power`.

    Attributes:
        places_of_square_metre: how many places an area of 1 m² had.
        power: below 1 where large car parks need more ways.
        levels: number of levels where the tags do not say it.
        typical: places of one whose area is unknown.
    """

    places_of_square_metre: float
    power: float
    levels: float
    typical: int


RULES = {
    "surface": AreaRule(0.1847, 0.7882, 1.0, 7),
    "boxes": AreaRule(0.0574, 1.0, 1.0, 4),
    "underground": AreaRule(0.0346, 1.0, 1.0, 30),
    "multi-storey": AreaRule(0.0377, 1.0, 4.7, 350),
    "rooftop": AreaRule(0.0342, 1.0, 1.0, 45),
}
"""Rule of each kind; fitted by `python tests/parking_rules.py`, which states the errors."""
KINDS = {
    **dict.fromkeys(("garage", "garages", "garage_boxes", "carport", "carports", "sheds"), "boxes"),
    **{"underground": "underground", "multi-storey": "multi-storey", "rooftop": "rooftop"},
}
"""Rule for each value of `parking`; `surface` for others."""
GARAGES = ("underground", "multi-storey", "rooftop")
"""Rules of what is a garage: it has a barrier and ramps."""


def rule_of(tags: Mapping[str, str]) -> str:
    """Return the name of the rule, a key of `RULES`, for a car park with these tags."""
    if "parking" not in tags and tags.get("building") == "parking":
        return "multi-storey"
    return KINDS.get(tags.get("parking", "surface"), "surface")


def levels_of(tags: Mapping[str, str]) -> float | None:
    """Return the tagged number of levels; None without one."""
    for key in ("parking:levels", "building:levels", "levels"):
        match = re.fullmatch(r"\s*(\d{1,2})(?:\.\d+)?\s*", tags.get(key, ""))
        if match and int(match[1]):
            return float(match[1])
    return None


def expected_capacity(rule: str, area: float | None, levels: float | None) -> int:
    """Return the number of places by the rule, at least 1.

    Args:
        rule: a key of `RULES`.
        area: m², of one level; None: unknown.
        levels: number of levels; None: unknown.
    """
    a = RULES[rule]
    if area is None:
        return a.typical
    expected = a.places_of_square_metre * float(area * (levels or a.levels)) ** a.power
    return max(int(expected + 0.5), 1)
