"""Settings of a study of many cars, and the columns of their days."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import BeforeValidator, WithJsonSchema

from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.results import Row
from parkenv.world.cost_terms import COST_FIELDS

OWN = "own"
NOWHERE = "no slot"  # stands for the block, and the zone, of cars that find no slot
COUNTED = "counted"
"""Arrivals with which the lot becomes as full as counted, or as its world says; `1.2x` are so many times these."""
GIVEN = "given"  # arrivals of the scenario's own demand; there, `1.2x` are so many times these
MAX_PER_HOUR = 1e6
SETTING_COLUMNS = ("scenario", "agents", "knows", "share", "arrivals_per_hour")
MEASURES = (
    "total_s", "median_s", "p95_s", "gini", "search_s", "queued_s", "failed_attempts", "driven_m", "cruised_m",
    "cruising_share", "balked_fraction", "occupancy", "counted_occupancy", "members_s", "others_s",
    "bound_s", "clairvoyant_s", *COST_FIELDS, "paid", "paying_share",
)  # fmt: skip
"""Measures of a day, of which a summary has the mean over days."""
CAR_LISTS = ("total_cs", "member", "zone", "paid_cents", "purpose")
"""Lists over the cars of a day, in the order of their arrivals: total time in centiseconds; 1 for members; and in lots
with zones or prices, number of the zone that a car parks in, from 1, or 0, and what it pays for its stay; of several
purposes, number of the car's, from 0."""
BY_HOUR = ("occupancy_by_hour", "counted_by_hour")
"""Columns with the mean share of taken slots in each hour of the day's arrivals, simulated and as counted."""
_WANTED = (
    f"a number above 0 and at most {MAX_PER_HOUR:g}, {GIVEN}, {COUNTED}, or so many times that, such as 1.2x"
)


def rate_of(value: float | str) -> float | str:
    """Return cars an hour, `given`, `counted`, or a multiple such as `1.2x`, from a number or a text.

    Raises:
        ValueError: it is none of these; the message says what was wanted.
    """
    text = str(value).strip()
    try:
        rate = 1.0 if text in (GIVEN, COUNTED) else float(text.removesuffix("x"))
    except ValueError:
        rate = -1.0
    if not 0.0 < rate <= MAX_PER_HOUR:
        raise ValueError(_WANTED)
    if text in (GIVEN, COUNTED):
        return text
    return f"{rate:g}x" if text.endswith("x") else rate


def times_demanded(rate: str) -> float:
    return 1.0 if rate in (GIVEN, COUNTED) else float(rate.removesuffix("x"))


_NUMBER_OR_TIMES = {
    "type": ["number", "string"], "exclusiveMinimum": 0, "maximum": MAX_PER_HOUR,
    "pattern": rf"^({GIVEN}|{COUNTED}|[0-9.]+x)$",
}  # fmt: skip
Demanded = Annotated[float | str, BeforeValidator(rate_of), WithJsonSchema(_NUMBER_OR_TIMES)]
"""Cars an hour, or multiples of the demand that is given or counted."""


@dataclass(frozen=True)
class Setting:
    """What a row of the summary is about.

    Args:
        scenario: name of the scenario.
        agent: agent that drives every car.
        knows: what members know, one of `KNOWLEDGE`.
        share: share of the cars that are members; the others know their own observations.
        arrivals_per_hour: cars an hour; `given`, `counted`, or a multiple such as `1.2x`, see `rate_of`.
    """

    scenario: str
    agent: AgentSpec
    knows: str
    share: float
    arrivals_per_hour: float | str

    @property
    def columns(self) -> Row:
        return {
            "scenario": self.scenario, "agents": self.agent.label, "knows": self.knows, "share": self.share,
            "arrivals_per_hour": self.arrivals_per_hour,
        }  # fmt: skip

    def holds(self, row: Row) -> bool:
        return all(row[name] == value for name, value in self.columns.items())

    def __str__(self) -> str:
        _, agent, knows, share, rate = self.columns.values()
        return f"{agent}, {knows}, share {share:g}, {rate_text(rate)}"


def rate_text(rate: float | str) -> str:
    """Return a demand in words: `60 cars an hour`, `demand as counted`."""
    if not isinstance(rate, str):
        return f"{rate:g} cars an hour"
    return f"demand as {rate}" if rate in (GIVEN, COUNTED) else f"{times_demanded(rate):g} times the demand"
