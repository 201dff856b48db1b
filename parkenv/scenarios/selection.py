"""Which of several scenarios an episode is in, which are kept from training, and scenarios without observations."""

import hashlib
from collections.abc import Sequence

import numpy as np

from parkenv.compiled.keyed_random import SCENARIO_STREAM, keyed_uniform, world_key
from parkenv.errors import InputError
from parkenv.world.lot import ParkingLot
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel

BLIND = "-blind"  # suffix of the names of these scenarios


def scenario_of_episode(seed: int, episode: int, n: int) -> int:
    """Return the index of the scenario, of n, that an environment draws for an episode of a seed.

    Examples:
        >>> [scenario_of_episode(seed, 0, 3) for seed in range(5)]
        [2, 0, 1, 0, 0]
    """
    return int(keyed_uniform(world_key(seed, episode), SCENARIO_STREAM, 0, 0) * n)


def seeds_by_scenario(seeds: Sequence[int], n: int) -> list[list[int]]:
    groups: list[list[int]] = [[] for _ in range(n)]
    for seed in seeds:
        groups[scenario_of_episode(seed, 0, n)].append(seed)
    return groups


def lot_share(lot: ParkingLot) -> float:
    """Return a number from 0 to 1 by a hash of the lot's slots, whatever their order and the lot's name.

    Examples:
        >>> from parkenv.lots import packaged_lot
        >>> round(lot_share(packaged_lot("campus")), 3)
        0.475
    """
    # Whole decimetres: readers of other formats may differ by rounding.
    centres = np.round(10.0 * lot.slot_xy).astype("<i8")
    digest = hashlib.sha256(centres[np.lexsort(centres.T)].tobytes()).digest()
    return int.from_bytes(digest[:8], "little") / 2.0**64


def split_by_lot(scenarios: Sequence[Scenario], held_out: float) -> tuple[list[Scenario], list[Scenario]]:
    """Split scenarios by `lot_share`: those to train on, and those held out below `held_out`."""
    sides: tuple[list[Scenario], list[Scenario]] = ([], [])
    for scenario in scenarios:
        sides[lot_share(scenario.lot) < held_out].append(scenario)
    for side, what in zip(sides, ("leaves none to train on", "holds out none"), strict=True):
        if not side:
            raise InputError(
                f"held_out is {held_out:g}, which {what} of {len(scenarios)} scenarios: "
                "name the others with evaluate_on"
            )
    return sides


def require_different_names(scenarios: Sequence[Scenario]) -> None:
    names = [scenario.name for scenario in scenarios]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputError(f"scenarios has {name!r} twice, want different names")


def blind_scenario(scenario: Scenario) -> Scenario:
    return scenario.replace(name=f"{scenario.name}{BLIND}", sensor_model=SensorModel.blind())
