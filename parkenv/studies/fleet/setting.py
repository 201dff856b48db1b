"""Settings of a study of many cars, and the columns of their days."""

from __future__ import annotations

from dataclasses import dataclass

from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.results import Row

OWN = "own"
SETTING_COLUMNS = ("scenario", "agents", "knows", "share", "arrivals_per_hour")
MEASURES = (
    "total_s", "median_s", "p95_s", "gini", "search_s", "queued_s", "failed_attempts", "driven_m", "cruised_m",
    "cruising_share", "balked_fraction", "occupancy", "members_s", "others_s", "bound_s", "clairvoyant_s",
)  # fmt: skip
"""Measures of a day, of which a summary has the mean over days."""
CAR_LISTS = ("total_cs", "member")
"""Lists over the cars of a day, in the order of their arrivals: total time in centiseconds, and 1 for members."""


@dataclass(frozen=True)
class Setting:
    """What a row of the summary is about.

    Args:
        scenario: name of the scenario.
        agent: agent that drives every car.
        knows: what members know, one of `KNOWLEDGE`.
        share: share of the cars that are members; the others know their own observations.
        arrivals_per_hour: cars an hour.
    """

    scenario: str
    agent: AgentSpec
    knows: str
    share: float
    arrivals_per_hour: float

    @property
    def columns(self) -> Row:
        """The columns that identify the row."""
        return {
            "scenario": self.scenario, "agents": self.agent.label, "knows": self.knows, "share": self.share,
            "arrivals_per_hour": self.arrivals_per_hour,
        }  # fmt: skip

    def __str__(self) -> str:
        _, agent, knows, share, per_hour = self.columns.values()
        return f"{agent}, {knows}, share {share:g}, {per_hour:g} cars an hour"
