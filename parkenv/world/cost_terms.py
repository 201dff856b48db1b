"""What a step of a search can cost: one table, from which records, sums, `info`, columns, tables and legends are made.

A new term is a row here, a line of `parkenv.engine.kernel` that charges it and a name in its `read_step`, and its data
in `parkenv.world.scenario.SearchProblem`: what a move costs belongs to `edges` and `move_cost_s`, what an arrival costs
to `arrival_cost_s`, so that planners foresee it.
"""

from typing import NamedTuple


class CostTerm(NamedTuple):
    """A part of the total time."""

    name: str  # with `reward_` before it, key of a step's part of the reward in `info`, where it is negative
    field: str  # key of its sum over an episode, s, in `info`, and name of its column in tables and records
    label: str  # name for people
    help: str  # explanation
    color: str  # in pictures and in reports on a light ground
    dark_color: str  # in reports on a dark ground
    optional: bool = False  # whether pictures and tables leave it out where it is 0 everywhere


# All terms, in the order in which they are added up.
COST_TERMS = (
    CostTerm("drive", "drive_s", "drive", "Time driving, waits included", "#0072b2", "#3b9bdc"),
    CostTerm(
        "failed", "failed_s", "failed attempts", "Time of failed parking attempts", "#d55e00", "#ee7f34"
    ),
    CostTerm("walk", "walk_s", "walk", "", "#a6cfe8", "#a9d3ef"),
    CostTerm(
        "parking", "parking_cost_s", "parking cost", "Cost of the slot, as time", "#cc79a7", "#e09bc4", optional=True
    ),
    CostTerm(
        "gave_up", "gave_up_s", "give-up penalty", "Charged where the lot is full or the search was truncated",
        "#8c8c8c", "#8f959b", optional=True,
    ),
)  # fmt: skip

# Keys of the parts of a step's reward in `info`; they add up to it.
REWARD_TERMS = tuple(f"reward_{term.name}" for term in COST_TERMS)
# Keys of the sums over an episode; they add up to `total_s`.
COST_FIELDS = tuple(term.field for term in COST_TERMS)
# Keys of the metrics of an episode so far in `info`.
METRICS = (*COST_FIELDS, "total_s", "driven_m", "walked_m", "failed_parks", "slots_passed", "parked")
