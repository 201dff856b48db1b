"""LMU Munich's planner in a fleet: cars share what they see, reserve bays, or adapt the probabilities of each other.

`python examples/peers/lmu_fleet.py --scenario campus --cars 30 --worlds 5` prints the mean total time of four fleets in
the same worlds, in about a minute. Source: see `examples/peers/lmu.py`.

| fleet | a car knows |
|---|---|
| alone | what it has seen |
| shared | what all cars have seen |
| reservations | also the bay that each other car heads for, which is closed to it while that car does |
| probabilities | also all plans: P(free) of a bay is less by the chance that another car, there before, parks in it |

What had to be guessed: another car parks in a bay of its plan if all bays before it are taken, with the probabilities
that it expects; a bay that it has found taken stays so. Which car plans first follows from the order of decisions.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from examples.peers.lmu import ReplannedMDP, Route
from parkenv import lot_v0
from parkenv.belief.slot_belief import SlotBelief

FLEETS = ("alone", "shared", "reservations", "probabilities")


class Member(ReplannedMDP):
    """A car that plans at every decision, by what the others plan."""

    reserves = False
    others: tuple[
        tuple[Route, float], ...
    ] = ()  # their plans, and when their searches began, s after this one's

    def target(self, here: int, belief: SlotBelief, memory: Route) -> int:
        """Return the first bay of a new plan."""
        self.plan(here, belief, memory)
        return memory.bays[0]

    def p_free(self, belief: SlotBelief, after_s: Any) -> Any:
        """Return P(free) of each bay on arrival, as the plans of others leave it."""
        p_free = super().p_free(belief, after_s)
        for route, later_s in self.others:
            if self.reserves:
                p_free[route.bays[:1]] = 0.0
                continue
            reached = 1.0  # probability that the other car comes so far
            for bay, free, arrival_s in zip(route.bays, route.p_free, route.arrival_s, strict=True):
                if arrival_s + later_s - belief.time < after_s[bay]:
                    p_free[bay] *= 1.0 - reached
                reached *= 1.0 - free
        return p_free


def total_times(fleet: str, scenario: str, cars: int, seed: int, **options: Any) -> list[float]:
    """Return the total time of each car, s, in one world."""
    env = lot_v0.env(scenario=scenario, cars=cars, knows="own" if fleet == "alone" else "shared", **options)
    env.reset(seed=seed)
    driver = Member(env.unwrapped.scenario.public())
    driver.reserves = fleet == "reservations"
    plans: dict[str, Route] = {}
    began: dict[str, float] = {}
    total_s = dict.fromkeys(env.agents, 0.0)
    for car in env.agent_iter():
        observation, reward, terminated, truncated, _ = env.last()
        total_s[car] -= reward
        if terminated or truncated:
            plans.pop(car, None)
            env.step(None)
            continue
        now, elapsed = observation["time"]
        began.setdefault(car, float(now - elapsed))
        if fleet in ("reservations", "probabilities"):
            driver.others = tuple((plan, began[o] - began[car]) for o, plan in plans.items() if o != car)
        action, plans[car] = driver.predict(observation, plans.get(car))
        env.step(int(action))
    return list(total_s.values())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", default="campus")
    parser.add_argument("--cars", type=int, default=30)
    parser.add_argument("--worlds", type=int, default=5)
    options = parser.parse_args()
    worlds = range(options.worlds)
    means = {
        fleet: np.array(
            [np.mean(total_times(fleet, options.scenario, options.cars, seed)) for seed in worlds]
        )
        for fleet in FLEETS
    }
    for fleet, by_world in means.items():
        against = by_world - means["alone"]
        error = against.std(ddof=1) / len(worlds) ** 0.5 if len(worlds) > 1 else np.nan
        print(
            f"{fleet:14} {by_world.mean():7.1f} s   minus alone {against.mean():+6.1f} s, standard error {error:.1f}"
        )


if __name__ == "__main__":
    main()
