"""The facilities of a town while it is imported: what makes each, and its line in the table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from parkenv.lots.draft import LotDraft
from parkenv.lots.generators import NO_SLOTS, Slots
from parkenv.lots.town.zones import Rules
from parkenv.world.facility import Facility

GATE_S = 10.0  # s that the barrier of a garage takes for a car
INSIDE_S = {"garage": (30.0, 120.0), "lot": (10.0, 30.0)}
"""Seconds from the entry of a counted facility to a space, when it is empty and when it is full."""
TABLE = ("name", "kind", "capacity", "capacity_from", "rule", "zone", "slots", "tagged", "element")
"""Columns of the table of facilities: `capacity_from` is tag, drawn, list or rule, `rule` which one; `slots` of the
capacity are drawn, the others counted; `tagged` is what the tags say; `element` is the way or node, of a kerb with its
side."""


@dataclass(eq=False)
class FacilityRow:
    """A facility: its line in the table, its rules, and what makes it."""

    name: str
    kind: str
    rules: Rules
    capacity_from: str  # `tag`, `drawn`, `rule` or `list`
    rule: str  # which rule
    element: str  # of the map; of a kerb with its side
    tagged: int | None = None  # number of places that the tags say
    slots: Slots = NO_SLOTS  # drawn ones
    slot_rules: list[Rules] = field(default_factory=list)
    counted: list[tuple[str, int, Rules]] = field(
        default_factory=list
    )  # name, places, rules of counted parts
    xy: tuple[float, float] | None = None


def facilities_of(row: FacilityRow, filled: set[str]) -> Iterator[Facility]:
    """Yield the facilities of a row of the table: one for drawn slots, one for each counted part."""
    if len(row.slots) and row.name in filled:
        yield Facility(row.name, row.kind, row.rules.zone(row.kind).name)
    for name, capacity, rules in row.counted if row.xy is not None else ():
        yield Facility(
            name,
            row.kind,
            rules.zone(row.kind).name,
            capacity,
            row.xy,
            GATE_S if row.kind == "garage" else 0.0,
            INSIDE_S.get(row.kind, INSIDE_S["lot"]),
            "sign" if row.kind == "garage" else "nothing",
        )


def table_of(rows: Sequence[FacilityRow], draft: LotDraft) -> list[dict[str, Any]]:
    """Return the table of facilities, those of the draft."""
    names, count = np.unique(draft.slots.facility, return_counts=True)
    slots = dict(zip(names.tolist(), count.tolist(), strict=True))
    counted = {facility.name: facility.capacity for facility in draft.facilities}
    table = []
    for row in rows:
        places = slots.get(row.name, 0) + sum(counted.get(name, 0) for name, _, _ in row.counted)
        if places:
            more = {
                "capacity": places,
                "zone": row.rules.zone(row.kind).name,
                "slots": slots.get(row.name, 0),
            }
            table.append({name: more[name] if name in more else getattr(row, name) for name in TABLE})
    return table
