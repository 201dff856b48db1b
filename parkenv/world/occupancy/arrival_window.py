"""Weekdays and times of day at which searches begin."""

import re
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from pydantic import Field

from parkenv.errors import InputError
from parkenv.files.field_types import NotNegative, Validated
from parkenv.world.week import DAY_S, HOUR_S

DAY_NAMES = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
DAY_GROUPS = {"weekdays": (0, 1, 2, 3, 4), "weekend": (5, 6), "all": (0, 1, 2, 3, 4, 5, 6)}


@dataclass(frozen=True)
class ArrivalWindow(Validated):
    """Weekdays and times of day at which searches begin.

    Args:
        weekdays: Monday = 0 ... Sunday = 6, without repeats.
        start_s: first second of the day, in [0, 86400).
        end_s: end of the window (exclusive), in [start_s, 86400]; if equal to start_s, all searches begin then.
    """

    weekdays: tuple[int, ...] = (0, 1, 2, 3, 4)
    start_s: Annotated[NotNegative, Field(lt=DAY_S)] = 8 * HOUR_S
    end_s: Annotated[NotNegative, Field(le=DAY_S)] = 13 * HOUR_S

    def __post_init__(self) -> None:
        super().__post_init__()
        days = tuple(self.weekdays)
        if not days or len(set(days)) != len(days) or not set(days) <= set(range(7)):
            raise InputError(f"weekdays is {days}, want different numbers from 0 (Mon) to 6 (Sun)")
        if self.end_s < self.start_s:
            raise InputError(f"end_s is {self.end_s}, want a number of at least start_s, {self.start_s:g}")
        object.__setattr__(self, "weekdays", days)

    @classmethod
    def parse(cls, hours: str, days: str = "weekdays") -> Self:
        """Parse a window as typed by a user.

        >>> ArrivalWindow.parse("08:00-09:30", days="mon,sat")
        ArrivalWindow(weekdays=(0, 5), start_s=28800.0, end_s=34200.0)

        Args:
            hours: `HH:MM-HH:MM`, with 24:00 allowed as the end.
            days: `weekdays`, `weekend`, `all`, or names as in `mon,tue`.
        """
        match = re.fullmatch(r"\s*(\d{1,2}):([0-5]\d)\s*-\s*(\d{1,2}):([0-5]\d)\s*", hours)
        if match is None:
            raise InputError(f"arrival hours are {hours!r}, want HH:MM-HH:MM, for example 08:00-13:00")
        start_h, start_min, end_h, end_min = map(int, match.groups())
        names = [name.strip() for name in days.lower().split(",")]
        if days.lower() in DAY_GROUPS:
            weekdays: tuple[int, ...] = DAY_GROUPS[days.lower()]
        elif set(names) <= set(DAY_NAMES):
            weekdays = tuple(DAY_NAMES.index(name) for name in names)
        else:
            wanted = f"{', '.join(DAY_GROUPS)}, or some of {','.join(DAY_NAMES)}"
            raise InputError(f"arrival days are {days!r}, want {wanted}")
        return cls(weekdays, start_h * HOUR_S + start_min * 60.0, end_h * HOUR_S + end_min * 60.0)

    def draw_second(self, key: np.uint64) -> float:
        """Draw a second of the day, uniform in the window, from the world's key."""
        # Specifications of commands parse windows, without compiled code.
        from parkenv.world.occupancy.kernel import draw_arrival

        return float(draw_arrival(np.uint64(key), 1, float(self.start_s), float(self.end_s))[1])
