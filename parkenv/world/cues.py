"""Cues: what shows that a parked car is about to leave, such as somebody who gets in."""

from dataclasses import dataclass

from pydantic import ConfigDict

from parkenv.errors import require
from parkenv.files.field_types import NotNegative, Positive, Probability, Validated

LEAD_S = 31.0
"""Mean time from the first cue to the departure, s.

It is the mean of 220 drivers at a mall from the open door on, while a car waited for the space; without one, 27 s
(Ruback and Juieng, Territorial defense in parking lots, Journal of Applied Social Psychology 27, 1997).
"""

SENSED = (0.026, 0.0014)
"""Hit and false-alarm rate of the thresholded cues of simulated sensors: `tests/builders/departure_cues.py score`."""

MOVING_S = 5.0
"""Time to move out of a slot, s: an assumption, the middle of 3 to 8."""


@dataclass(frozen=True)
class Cues(Validated):
    """Departures that announce themselves, and how well that is observed of a car whose slot is observed.

    The time from the first cue to the departure is exponential, and never longer than the stay.

    Args:
        lead_s: its mean, s.
        hit_rate: P(cue observed | about to leave), at each observation of the slot.
        false_alarm_rate: P(cue observed | not about to leave).
        moving_s: for how long at most, at the end, the car moves out and is in the way of one that drives past, s; in
            fleets, manoeuvres block lanes instead.

    Raises:
        InputError: a value out of its range, or a false-alarm rate above the hit rate. Equal rates say nothing: cars
            leave as with other cues, and nobody notices.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", strict=False)  # as a table of a scenario file

    lead_s: Positive = LEAD_S
    hit_rate: Probability = 1.0
    false_alarm_rate: Probability = 0.0
    moving_s: NotNegative = MOVING_S

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.hit_rate >= self.false_alarm_rate,
            f"hit_rate is {self.hit_rate:g}, want at least false_alarm_rate, {self.false_alarm_rate:g}",
        )
