"""The parking game of Kokolaki, Karaliopoulos and Stavrakakis (2012): cheap places on the street, or a garage.

N drivers choose at once, between R places on the street at cost 1 and a garage at cost beta. Of those who compete for
the street, R get a place; the others search without success and pay gamma > beta. If n >= R compete, each expects
(R + gamma(n - R))/n, which is at most beta if and only if n <= N0 = R(gamma - 1)/(gamma - beta). So all compete up to
N = N0, and N0 of them beyond; the best is that R compete. The price of anarchy is (R + gamma(N - R))/(R + beta(N - R))
up to N0; beyond, everybody expects beta in equilibrium, and it is beta N/(R + beta(N - R)).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots.generators import Slots, grid_lot
from parkenv.studies.verify.queues import lane
from parkenv.studies.verify.rows import Row, Task, certain_row
from parkenv.world.demand import ConstantTime, Demand, Headways
from parkenv.world.lot import ParkingLot
from parkenv.world.scenario import Scenario
from planners.heuristics import POLICIES

SOURCE = "Kokolaki et al. 2012"
PLACES, STREET, GARAGE, FAILED = 50, 1.0, 5.0, 7.0  # R; costs: 1, beta, gamma
DRIVERS = (60, 75, 120, 150, 200)
_TIE = 1e-9


def street() -> Scenario:
    """Return a lot of `PLACES` slots at the price of the street, and a failed search at the price of the garage."""
    plain = grid_lot(2, PLACES // 2)
    slots = Slots.of_lot(plain)
    lot = ParkingLot(
        name="street",
        slot_ids=plain.slot_ids,
        **Slots(
            slots.xy, slots.yaw, slots.length, slots.width, slots.mouth, slots.parking_cost_s + STREET
        ).columns(),
        lanes=plain.lanes,
        entries=plain.entries,
        goals=plain.goals,
    )
    occupancy = lane(lot.n_slots).occupancy
    return lane(1).replace(lot=lot, occupancy=occupancy, give_up_s=FAILED)


class Game:
    """The game, played by cars that drive: what those who compete pay comes from a fleet on the street.

    Args:
        seed: seed of their arrivals, a second apart on average.
    """

    def __init__(self, seed: int) -> None:
        self._seed, self._scenario, self._costs = seed, street(), dict[int, float]()

    def competing_cost(self, competing: int) -> float:
        """Return what all competing drivers pay together: prices of places, and failed searches."""
        if competing not in self._costs:
            demand = Demand(Headways(competing, 1.0), ConstantTime(float("inf"))) if competing else None
            self._costs[competing] = 0.0 if demand is None else self._drive(demand)
        return self._costs[competing]

    def _drive(self, demand: Demand) -> float:
        kind = DriverKind(policy=POLICIES["greedy-drive"])
        fleet = Fleet(self._scenario, demand, background="none", drivers=(kind,))
        fleet.reset(self._seed)
        fleet.run()
        return float((fleet.cars["parking_cost_s"] + fleet.cars["gave_up_s"]).sum())

    def social_cost(self, competing: int, drivers: int) -> float:
        """Return what all drivers pay together."""
        return self.competing_cost(competing) + GARAGE * (drivers - competing)

    def equilibrium(self, drivers: int) -> int:
        """Return how many compete once nobody gains by changing sides (best responses, from all competing on)."""
        competing = drivers
        while competing > 0 and self.competing_cost(competing) / competing > GARAGE + _TIE:
            competing -= 1
        joined = competing + 1
        assert competing == drivers or self.competing_cost(joined) / joined > GARAGE - _TIE
        return competing

    def price_of_anarchy(self, drivers: int) -> float:
        """Return the social cost in equilibrium over the least."""
        least = min(self.social_cost(competing, drivers) for competing in range(drivers + 1))
        return self.social_cost(self.equilibrium(drivers), drivers) / least


def expected_price(drivers: int) -> float:
    """Return the price of anarchy of the literature."""
    selfish = GARAGE * drivers
    if drivers <= PLACES * (FAILED - STREET) / (FAILED - GARAGE):
        selfish = PLACES * STREET + FAILED * (drivers - PLACES)
    return selfish / (PLACES * STREET + GARAGE * (drivers - PLACES))


def rows(seed: int) -> list[Row]:
    """Return the price of anarchy for some numbers of drivers, and how many compete among the most."""
    game = Game(seed)
    made = [
        certain_row(
            f"parking game, {drivers} drivers: price of anarchy",
            expected_price(drivers),
            game.price_of_anarchy(drivers),
            SOURCE,
        )
        for drivers in DRIVERS
    ]
    compete = PLACES * (FAILED - STREET) / (FAILED - GARAGE)
    found = game.equilibrium(max(DRIVERS))
    return [*made, certain_row(f"parking game, {max(DRIVERS)} drivers: compete", compete, found, SOURCE)]


CASES: dict[str, Callable[[int], list[Task]]] = {"game": lambda seed: [partial(rows, seed)]}
