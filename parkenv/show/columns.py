"""Columns of result tables: how a terminal, a page and a figure label and format them."""

from __future__ import annotations

from typing import NamedTuple

from parkenv.world.cost_terms import COST_TERMS

SETTING_AXES = ("failure_cost_s", "v_walk_kmh", "v_drive_kmh")  # columns of a setting of costs and speeds


class Column(NamedTuple):
    """Format of a column.

    Attributes:
        key: key in the summary.
        label: heading.
        unit: unit of the numbers; empty for none.
        digits: number of decimals.
        share: whether the value is a fraction, shown as a percentage.
        signed: whether positive values get a plus sign.
        help: explanation.
        given: whether the numbers were chosen, and keep all their digits.
        setting: whether the value stands above the table if it is equal in all rows, as measures never do.
        needs: column that must differ from 0 in some row for this one to be shown.
    """

    key: str
    label: str
    unit: str = ""
    digits: int = 1
    share: bool = False
    signed: bool = False
    help: str = ""
    given: bool = False
    setting: bool = False
    needs: str = ""


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
    Column("gap_to_exact", "above the optimum", share=True, digits=2, signed=True),
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
"""Columns of searches, in the order of tables."""


def shared(*keys: str) -> tuple[Column, ...]:
    return tuple(column for column in SHARED if column.key in keys)
