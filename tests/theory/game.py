"""The parking game: cheap places on the street, or a garage."""

from functools import cache, partial

from closed_forms import Statement, closed_form
from queues import lane

from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots.generators import Slots, grid_lot
from parkenv.world.demand import ConstantTime, Demand, Headways
from parkenv.world.lot import ParkingLot
from planners.heuristics import POLICIES

PLACES, STREET, GARAGE, FAILED = 50, 1.0, 5.0, 7.0  # R; costs: 1, beta, gamma
LIMIT = PLACES * (FAILED - STREET) / (FAILED - GARAGE)
DRIVERS = (60, 75, 120, 150, 200)


@cache
def street():
    """Return a lot of `PLACES` slots at the price of the street, with the cost of a failed search."""
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
    return lane(1).replace(lot=lot, occupancy=lane(lot.n_slots).occupancy, give_up_s=FAILED)


@cache
def competing_cost(competing):
    """Return what all who compete for the street pay: read from a fleet of cars that drive there."""
    if competing == 0:
        return 0.0
    demand, kind = Demand(Headways(competing, 1.0), ConstantTime(float("inf"))), POLICIES["greedy-drive"]
    fleet = Fleet(street(), demand, background="none", drivers=(DriverKind(policy=kind),))
    fleet.reset(0)
    fleet.run()
    return float((fleet.cars["parking_cost_s"] + fleet.cars["gave_up_s"]).sum())


def social_cost(competing, drivers):
    """Return what all drivers pay together."""
    return competing_cost(competing) + GARAGE * (drivers - competing)


def equilibrium(drivers):
    """Return how many compete once nobody gains by changing sides (best responses, from all competing on)."""
    competing = drivers
    while competing > 0 and competing_cost(competing) / competing > GARAGE + 1e-9:
        competing -= 1
    assert competing == drivers or competing_cost(competing + 1) / (competing + 1) > GARAGE - 1e-9
    return competing


def price_of_anarchy(drivers):
    """Return the social cost in equilibrium over the least."""
    least = min(social_cost(competing, drivers) for competing in range(drivers + 1))
    return social_cost(equilibrium(drivers), drivers) / least


def expected_price(drivers):
    """Return the price of anarchy of the literature."""
    selfish = PLACES * STREET + FAILED * (drivers - PLACES) if drivers <= LIMIT else GARAGE * drivers
    return selfish / (PLACES * STREET + GARAGE * (drivers - PLACES))


@closed_form("The parking game", "Kokolaki, Karaliopoulos & Stavrakakis 2012")
def parking_game():
    r"""\(N\) drivers choose at once between \(R\) places on the street at cost 1 and a garage at cost \(\beta\). Of
    those who compete for the street, \(R\) succeed; the others pay \(\gamma > \beta\), garage and wasted search.
    If \(n \ge R\) compete, each expects \((R + \gamma(n - R))/n\), at most \(\beta\) if and only if \(n \le N_0 =
    R(\gamma-1)/(\gamma-\beta)\). So in equilibrium \(\min(N, N_0)\) compete, where \(R\) should. The price of
    anarchy, cost in equilibrium over the least cost, is \([R + \gamma(N-R)]/[R + \beta(N-R)]\) up to \(N_0\), and
    \(\beta N/[R + \beta(N-R)]\) beyond. Here \(R = 50\), \(\beta = 5\), \(\gamma = 7\).

    Those who compete drive (`greedy-drive`) in a lot of 50 slots until they park or have proven it full, and what
    they pay is read from the fleet; drivers then switch one by one until no driver gains.
    """
    prices = [
        Statement(f"{n} drivers: price of anarchy", expected_price(n), partial(price_of_anarchy, n))
        for n in DRIVERS
    ]
    return [*prices, Statement("200 drivers: compete", LIMIT, partial(equilibrium, 200))]
