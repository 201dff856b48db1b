"""Two drivers in a lot of three slots: every pure strategy and every state of the slots is tried in the engine."""

import itertools
from functools import partial

import numpy as np
import pytest

from parkenv import OccupancyProcess, SensorModel, make_scenario
from parkenv.belief.slot_belief import SlotBelief
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots import grid_lot
from parkenv.world.demand import ConstantTime, Demand, ListedArrivals
from parkenv.world.lot import PARK
from planners import make_agent

LOT = grid_lot(1, 3, pitch=12.0)


class FromSlot:
    def __init__(self, first, world):
        del world
        self.first = first

    def predict(self, observation, state=None):
        last = -1 if state is None else state
        vertex = int(observation["vertex"])
        known = SlotBelief.of_observation(observation)
        if vertex < 3 and known.observed_free[vertex] and (vertex >= self.first or last == 3):
            return PARK, last
        (ahead,) = np.flatnonzero(LOT.neighbors[vertex] >= 0)[:1]
        return int(ahead), 3 if vertex == 2 else last


def scenario(p_taken, taken, v_walk):
    occupancy = OccupancyProcess.from_demand(np.where(taken, 25.0, -25.0), np.zeros(168), 1e9)
    logit = np.log(p_taken / (1.0 - p_taken))
    prior = OccupancyProcess.from_demand(np.full(3, logit), np.zeros(168), 600.0)
    blind = SensorModel(view_range=0.0)
    return make_scenario(
        LOT, occupancy=occupancy, prior=prior, sensor_model=blind, v_walk=v_walk, give_up_s=120.0
    )


def costs(p_taken, v_walk, drivers):
    total_s = np.zeros((len(drivers), len(drivers), 2))
    arrivals = ListedArrivals((8 * 3600.0, 8 * 3600.0 + 2.0))
    demand = Demand(arrivals, ConstantTime(3600.0), ConstantTime(120.0))
    for taken in itertools.product((False, True), repeat=3):
        world = scenario(p_taken, np.array(taken), v_walk)
        p = np.where(taken, p_taken, 1.0 - p_taken).prod()
        kinds = [DriverKind(), DriverKind()]
        for i, first in enumerate(drivers):
            for j, second in enumerate(drivers):
                fleet = Fleet(world, demand, drivers=kinds, background="process", leave_full_lot=False)
                fleet.reset(0)
                agents, memory = [make(world) for make in (first, second)], [None, None]
                while (car := fleet.next_decision()) is not None:
                    action, memory[car] = agents[car].predict(fleet.observation(car), memory[car])
                    fleet.act(action)
                total_s[i, j] += p * fleet.cars["total_s"]
    return total_s


def equilibria(total_s):
    first, second = total_s[..., 0], total_s[..., 1]
    least = (first <= first.min(axis=0) + 1e-9) & (second <= second.min(axis=1, keepdims=True) + 1e-9)
    return [tuple(pair) for pair in np.argwhere(least)]


def ours(world):
    return make_agent("belief-rivals", world, arrivals_per_hour=20)


@pytest.mark.parametrize(("p_taken", "v_walk"), [(0.5, 1.1), (0.3, 0.3), (0.1, 0.3)])
def test_two_of_it_need_no_longer_than_in_equilibrium_and_the_second_cannot_gain(p_taken, v_walk):
    total_s = costs(p_taken, v_walk, [*(partial(FromSlot, k) for k in range(3)), ours])
    exact = equilibria(total_s[:3, :3])
    assert exact
    assert total_s[3, 3].mean() < 1.01 * min(total_s[pair].mean() for pair in exact)
    first, second = total_s[3, 3]
    assert second < total_s[3, :3, 1].min() + 1.0
    # It reckons with more rivals than the one behind it, so in front it may stop too early.
    assert first < total_s[:3, 3, 0].min() + 25.0
