"""Which searches, drives and days of a run the page on it replays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import Field

from parkenv.errors import InputError, nearest
from parkenv.files.option import option
from parkenv.files.spec_file import Several, Spec
from parkenv.studies.agent_spec import split_agents


class NotInRunError(InputError):
    """A search, a day or an agent was chosen that the run does not have."""


class ReportOptions(Spec):
    """What a page replays."""

    episodes: int | None = option(
        None,
        "About how many episodes to replay, all agents together.",
        short="-n",
        default="20; through simulated sensors 4; 8 days of a fleet",
        ge=0,
    )
    numbers: Several[float] | None = option(
        None,
        "Replay the episodes with these seeds, or these days of a fleet.",
        name="--replay",
        takes="SEED[,...]",
        min_length=1,
    )
    agents: Several[str] | None = option(
        None, "Replay only these agents.", takes="NAME[,...]", parse=split_agents
    )
    sessions: int = option(1, "Survey drives to replay.", ge=0)
    frames: int = option(120, "Captures of them to keep, all drives together.", ge=2, le=250)
    drives: Sequence[dict[str, Any]] | None = Field(
        None, description="Recorded drives to use instead of driving again."
    )

    def chosen_agents(self, known: Sequence[str]) -> Sequence[str]:
        for name in self.agents or ():
            if name not in known:
                raise NotInRunError(f"--agents has {name!r}; {nearest(name, list(dict.fromkeys(known)))}")
        return known if self.agents is None else self.agents

    def chosen_numbers(self, known: Sequence[int]) -> list[int] | None:
        """Return which seeds or days of a run are replayed; None to choose them."""
        for number in self.numbers or ():
            if number not in known:
                span = f"{known[0]} to {known[-1]}" if known else "none"
                raise NotInRunError(f"--replay has {number:g}; this run's are {span}")
        return None if self.numbers is None else [int(number) for number in self.numbers]
