"""Options of a fleet, and its kinds of drivers."""

from __future__ import annotations

from dataclasses import dataclass

from parkenv.engine.policy import CompiledPolicy
from parkenv.engine.records import BACKGROUNDS
from parkenv.errors import InputError, require_number, require_one_of, require_whole
from parkenv.files.known_names import KNOWLEDGE

TIMES = ("tick_s", "delay_s", "manoeuvre_s", "leaving_soon_s")
"""Options that are times, s, and fields of the FLEET record."""


@dataclass(frozen=True)
class DriverKind:
    """A kind of driver in a fleet.

    Args:
        weight: relative number of such drivers. A car's kind follows from its own random number, so with two kinds and
            equal demand, the drivers of the first kind stay the same, and more join them, as its weight grows.
        policy: compiled policy that decides, such as `planners.heuristics.policies.POLICIES["greedy-drive"]`; None:
            Python decides.
        knows: what these drivers know of the slots besides the forecast: `own`, their own observations; `shared`, also
            those on the live map; `reserve`, the slot that a guidance system has reserved for them; `full`, the true
            state of every slot.
        shares: whether they report their observations, and that they park and leave, to the live map.

    Raises:
        InputError: a value out of its range; the message names the field.
    """

    weight: float = 1.0
    policy: CompiledPolicy | None = None
    knows: str = "own"
    shares: bool = False

    def __post_init__(self) -> None:
        require_number("DriverKind.weight", self.weight, least=0.0)
        if self.policy is not None and not isinstance(self.policy, CompiledPolicy):
            raise InputError(f"DriverKind.policy is {self.policy!r:.60}, want a CompiledPolicy or None")
        require_one_of("DriverKind.knows", self.knows, KNOWLEDGE)


@dataclass(frozen=True, kw_only=True)
class FleetOptions:
    """Options of a fleet; `parkenv.engine.fleet.Fleet` describes what they change.

    Args:
        drivers: the kinds of drivers.
        background: other cars that take slots: `residents`, which are parked when the world begins, drawn from the
            scenario's occupancy, and leave once; `process`, the scenario's occupancy all day; `none`: the lot is
            empty when the world begins. By default residents; none if cars of the demand are parked then.
        max_steps: limit of a car's decisions; by default that of `parkenv/Search-v2`.
        leave_full_lot: whether a car gives up once it knows every slot to be taken; otherwise it searches on until its
            patience is at an end. An informed car knows it at once, so compare kinds of knowledge with False.
        tick_s: durations of steps, and arrivals, are rounded up to multiples of this, s; 0: continuous time.
        delay_s: time after which a report is on the live map, s.
        manoeuvre_s: time for which a car that parks or leaves blocks its lane, s; 0: no car blocks a lane.
        leaving_soon_s: time for which cars signal that they are about to leave, s.
        sees_cars: whether observations hold the other cars in view.

    Raises:
        InputError: a value out of its range; the message names the field.
    """

    drivers: tuple[DriverKind, ...] = (DriverKind(),)
    background: str | None = None
    max_steps: int = 2000
    leave_full_lot: bool = True
    tick_s: float = 0.0
    delay_s: float = 0.0
    manoeuvre_s: float = 0.0
    leaving_soon_s: float = 0.0
    sees_cars: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "drivers", tuple(self.drivers))
        if not self.drivers or not all(isinstance(kind, DriverKind) for kind in self.drivers):
            raise InputError(f"drivers is {self.drivers!r:.60}, want at least one DriverKind")
        if not sum(kind.weight for kind in self.drivers) > 0.0:
            raise InputError("drivers: all weights are 0, want one above 0")
        require_one_of("background", self.background, (None, *BACKGROUNDS))
        require_whole("max_steps", self.max_steps, least=1)
        for name in TIMES:
            require_number(name, getattr(self, name), least=0.0)
