"""The parking game: cheap places on the street, or a garage."""

from functools import cache, partial

from closed_forms import Statement, closed_form
from queues import lane
from small_lots import driven, features

from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots.generators import grid_lot
from parkenv.world.demand import ConstantTime, Demand, Headways
from parkenv.world.lot import ParkingLot
from planners.heuristics import POLICIES

PLACES, STREET, GARAGE, FAILED = 50, 1.0, 5.0, 7.0  # R; costs: 1, beta, gamma
LIMIT = PLACES * (FAILED - STREET) / (FAILED - GARAGE)
DRIVERS = (60, 75, 120, 150, 200)


@cache
def street():
    plain = grid_lot(2, PLACES // 2)
    lot = ParkingLot(**features(plain) | {"slot_parking_cost_s": plain.slot_parking_cost_s + STREET})
    return lane(1).replace(lot=lot, occupancy=lane(lot.n_slots).occupancy, give_up_s=FAILED)


@cache
def competing_cost(competing):
    if competing == 0:
        return 0.0
    demand, kind = Demand(Headways(competing, 1.0), ConstantTime(float("inf"))), POLICIES["greedy-drive"]
    fleet = Fleet(street(), demand, background="none", drivers=(DriverKind(policy=kind),))
    cars = driven(fleet, 0).cars
    return float((cars["parking_cost_s"] + cars["gave_up_s"]).sum())


def social_cost(competing, drivers):
    return competing_cost(competing) + GARAGE * (drivers - competing)


def equilibrium(drivers):
    competing = drivers
    while competing > 0 and competing_cost(competing) / competing > GARAGE + 1e-9:
        competing -= 1
    assert competing == drivers or competing_cost(competing + 1) / (competing + 1) > GARAGE - 1e-9
    return competing


def price_of_anarchy(drivers):
    least = min(social_cost(competing, drivers) for competing in range(drivers + 1))
    return social_cost(equilibrium(drivers), drivers) / least


def expected_price(drivers):
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
