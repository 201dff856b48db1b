"""Turn restrictions of a map as turns of a lot: those between its lanes, as far as every street still leads on."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.lots.draft import LeftOut
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.elements import OsmMap
from parkenv.world.drive_graph import NODE_TOLERANCE, centrelines
from parkenv.world.lot import Lane, Turn
from parkenv.world.turns import Chains, Rule, connected, rules_of

NO_LANE, SPLIT, CUTS = (
    "on streets that are no lanes",
    "at a junction that is split",
    "that would cut streets off",
)
"""Why turns are left out."""


class Turns(NamedTuple):
    """The turns of a lot.

    Attributes:
        kept: those that it has.
        found: a line that counts the restrictions of the map; none if there are none.
        left_out: those left out.
    """

    kept: tuple[Turn, ...]
    found: tuple[str, ...]
    left_out: tuple[LeftOut, ...]


def turns_of(
    place: OsmMap, frame: LocalFrame, whole: Sequence[Lane], lanes: Sequence[Lane], *, away: bool = True
) -> Turns:
    """Return the turns of a lot.

    Left out are those whose streets are no lanes of the lot, those at junctions that were split, and those with which
    some street could not be reached, or left, that can be without: the map is incomplete there.

    Args:
        place: the map.
        frame: frame of the lot.
        whole: the lanes before junctions were split (`limit_junctions`).
        lanes: the lanes.
        away: whether restrictions away from the lanes are listed, too.
    """
    named = [(turn.id, Turn(frame.to_xy(turn.line), turn.only)) for turn in place.turns]
    why = [NO_LANE] * len(named)
    if named and lanes:
        at = np.array([turn.points[1] for _, turn in named])
        before, after = _arms_at(whole, at), _arms_at(lanes, at)
        if not away:
            named = [one for one, arms in zip(named, before, strict=True) if arms]
            before, after = before[before > 0], after[before > 0]
        split = (before != after).tolist()
        why = _reasons(lanes, [turn for _, turn in named], split)
    kept = {relation for (relation, _), reason in zip(named, why, strict=True) if not reason}
    listed: dict[str, dict[str, None]] = defaultdict(dict)
    for (relation, _), reason in zip(named, why, strict=True):
        if relation not in kept:
            listed[reason][relation] = None
    left_out = [LeftOut(reason, tuple(those)) for reason, those in listed.items()]
    if away:
        left_out += place.turns_left_out
    n_out = sum(len(left.ids) for left in left_out)
    reasons = ", ".join(f"{left.reason}: {len(left.ids)}" for left in left_out)
    line = f"turn restrictions: {len(kept)} kept" + (f", {n_out} left out ({reasons})" if n_out else "")
    return Turns(
        tuple(turn for (_, turn), reason in zip(named, why, strict=True) if not reason),
        (line,) if kept or n_out else (),
        tuple(LeftOut(f"turn restrictions {left.reason}", left.ids) for left in left_out),
    )


def _arms_at(lanes: Sequence[Lane], at: FloatArray) -> IntArray:
    """Return how many stretches of lanes meet at points, (n,)."""
    arms = np.concatenate([np.r_[1, np.full(len(lane.points) - 2, 2), 1] for lane in lanes])
    near = cKDTree(np.concatenate([lane.points for lane in lanes])).query_ball_point(at, NODE_TOLERANCE)
    return np.array([arms[those].sum() for those in near], np.int64)


def _reasons(lanes: Sequence[Lane], turns: Sequence[Turn], split: Sequence[bool]) -> list[str]:
    """Return why each turn cannot be kept, empty where it can."""
    chains = centrelines([(lane.points, lane.oneway, lane.speed) for lane in lanes]).chains
    rules = rules_of(chains, [(turn.points, turn.only) for turn in turns])
    why = [
        SPLIT if its else "" if isinstance(rule, Rule) else NO_LANE
        for its, rule in zip(split, rules, strict=True)
    ]
    left = [(i, rule) for i, rule in enumerate(rules) if isinstance(rule, Rule) and not why[i]]
    kept = _without_cuts(chains, [rule for _, rule in left])
    for (i, _), fits in zip(left, kept.tolist(), strict=True):
        why[i] = "" if fits else CUTS
    return why


def _without_cuts(chains: Chains, rules: Sequence[Rule]) -> BoolArray:
    """Return which rules leave each chain connected with the others, (n,) bool: those that do not are tried last."""
    whole, of = connected(chains, []), np.array([rule.chain for rule in rules], np.int64)
    node, inside = chains.last[of], whole[of]
    kept = inside.copy()

    def lost() -> BoolArray:
        return whole & ~connected(chains, [rule for rule, its in zip(rules, kept, strict=True) if its])

    while (cut := np.flatnonzero(lost())).size:
        touching = kept & np.isin(node, [chains.first[cut], chains.last[cut]])
        kept &= ~(touching if touching.any() else kept)
    for i in np.flatnonzero(inside & ~kept).tolist():
        kept[i] = True
        kept[i] = not lost().any()
    return kept
