"""Small lots: random ones on which the optimum is known exactly, and one in two parts."""

from dataclasses import fields

import numpy as np

from parkenv import Lane, OccupancyProcess, ParkingLot, Scenario, SearchProblem, SensorModel
from parkenv.lots import grid_lot

CAR_PARKS = ("campus", "jam", "street", "mini")
"""Packaged scenarios of one car park each: the town takes too long for every test."""

SHAPES = ((1, 12), (2, 6), (4, 3), (2, 5), (3, 4), (1, 9))
PITCHES = (2.5, 6.0, 15.0)
VIEWS = (0.0, 6.0)
MEAN_FREE = (0.1, 0.3, 0.6)
SLOT_COLUMNS = (
    "slot_yaw", "slot_length", "slot_width", "slot_mouth", "slot_parking_cost_s", "slot_zone", "slot_facility",
)  # fmt: skip


def features(lot):
    """Parameters of a lot, by name."""
    return {f.name: getattr(lot, f.name) for f in fields(lot) if f.init}


def small_lot(seed: int, shapes=SHAPES):
    """Problem, forecast and entry: rows and aisles, any goal, any speeds; 324 seeds are three full rounds.

    The slots' chances rise with the walk, are all the same, or follow a beta distribution. Odd seeds have slots with a
    price.
    """
    rng = np.random.default_rng([7, seed])
    plain = grid_lot(*shapes[seed % len(shapes)], pitch=PITCHES[seed // 6 % 3])
    west, south, east, north = plain.bounds()
    goal = [[rng.uniform(west - 10.0, east + 10.0), rng.uniform(south - 10.0, north + 10.0)]]
    changes = {"goals": np.array(goal), "slot_parking_cost_s": prices(plain, seed)}
    problem = SearchProblem(
        lot=ParkingLot(**features(plain) | changes),
        v_drive=rng.uniform(1.5, 4.0),
        v_walk=rng.uniform(0.8, 1.6),
        give_up_s=300.0,
        sensor_model=SensorModel(view_range=VIEWS[seed // 18 % 2]),
    )
    mean, walk, n = MEAN_FREE[seed // 36 % 3], problem.walk_s, problem.lot.n_slots
    if seed % 3 == 0:
        far = (walk - walk.min()) / (np.ptp(walk) + 1e-9)
        free = 2.0 * mean * (0.15 + 0.85 * far) * rng.uniform(0.6, 1.4, n)
    elif seed % 3 == 1:
        free = np.full(n, mean)
    else:
        free = rng.beta(4.0 * mean, 4.0 * (1.0 - mean), n)
    return problem, 1.0 - np.clip(free, 0.01, 0.99), int(problem.lot.entry_vertices[0])


def prices(lot, seed):
    """Parking cost of each slot, s."""
    return np.random.default_rng([8, seed]).choice([0.0, 5.0, 40.0], lot.n_slots) * (seed % 2)


def cut_in_two():
    """Two lots side by side; the entry leads into the western one alone."""
    west = grid_lot(2, 5)
    f, shift = features(west), np.array([200.0, 0.0])
    n = west.n_slots
    return ParkingLot(
        **{
            **f,
            "slot_ids": tuple(map(str, range(2 * n))),
            "slot_xy": np.concatenate([west.slot_xy, west.slot_xy + shift]),
            **{k: np.tile(f[k], 2) for k in SLOT_COLUMNS},
            "lanes": (*west.lanes, *(Lane(lane.points + shift, lane.oneway) for lane in west.lanes)),
            "goals": west.goals + shift,
        }
    )


def lasting(lot, taken, said=0.0, **changes):
    """A scenario with slots that are taken, or free, for good; the forecast has the logit `said` for each."""
    logits = np.where(taken, 25.0, -25.0), np.full(lot.n_slots, said)
    occupancy, prior = (OccupancyProcess.from_demand(each, np.zeros(168), 1e9) for each in logits)
    return Scenario(name="lasting", lot=lot, occupancy=occupancy, prior=prior, **changes)


def full_lot(lot):
    """A scenario in which all slots are taken for good, and forecast to be free now and then, some more than others."""
    n = lot.n_slots
    taken = OccupancyProcess.from_demand(np.full(n, 25.0), np.zeros(168), 1e9)
    logits = np.random.default_rng(0).normal(1.5, 1.0, n)
    forecast = OccupancyProcess.from_demand(logits, np.zeros(168), 3600.0)
    return Scenario(name="full", lot=lot, occupancy=taken, prior=forecast)


def driven(fleet, *day, agents=None):
    """A fleet at the end of a day, which a seed and a number name."""
    fleet.reset(*day)
    fleet.run(agents)
    return fleet
