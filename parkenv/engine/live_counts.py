"""Live counts of facilities, as observations of a search."""

from __future__ import annotations

import math
from typing import Any

from parkenv.compiled.memory import float32s, float64s, int64s
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    FORECAST,
    block_at,
    counted_at,
    scenario_at,
    shared_world_at,
    slot_at,
)
from parkenv.engine.search_belief import column_of, forecast_of, is_forbidden, is_taken, set_belief
from parkenv.world.occupancy import kernel as worlds
from parkenv.world.occupancy.kernel import SHARED_KIND, inlined, kernel

_LOGISTIC = 1.702  # the logistic law of z times this is closest to the normal one
_SURE = 8.0  # standard deviations beyond which a facility is surely full, or not
_ABOVE = 1e-3  # how far above its forecast a facility is at least whose count says that it is full


@kernel
def observe_live(search: Any) -> None:
    """Take in the live counts of facilities; those in view are known exactly.

    A full facility is an observation of a taken slot, another one of a free slot, with P(full) on arrival there. Where
    that is above the forecast although there is room, the forecast rises to it.
    """
    scenario, live = scenario_at(search.scenario, 0), int64s(scenario_at(search.scenario, 0).live)
    for i in range(scenario.n_live):
        slot = live[i]
        column = column_of(search, slot)
        record, k = slot_at(search.slots, column), column & (BLOCK_SIZE - 1)
        block = block_at(search.blocks, column >> BLOCK_BITS)
        in_view = record.observed and block.observed_at[k] == search.time
        if in_view or (search.n_forbidden > 0 and is_forbidden(search, slot)):
            continue
        if scenario.world_kind != SHARED_KIND:
            taken = is_taken(search, column, search.time)
            set_belief(search, column, taken, 1.0 if taken else 0.0)
            continue
        world = shared_world_at(search.world, 0)
        counted = counted_at(world.counted, slot - world.first_counted)
        publish_count(counted, search.time)
        age_s = search.time - counted.period * counted.delay_s if counted.delay_s > 0.0 else 0.0
        n_vertices = scenario.n_vertices
        ahead_s = age_s + float64s(scenario.live_drive_s)[n_vertices * i + search.vertex]
        forecast, _ = forecast_of(search, slot)
        p = p_full(forecast, counted.published, counted.capacity, scenario.turnover * ahead_s)
        taken = counted.published >= counted.capacity
        block.prior[k] = forecast if taken else max(forecast, p)
        if search.belief != 0:
            float32s(search.belief)[FORECAST * search.width + slot] = block.prior[k]
        set_belief(search, column, taken, max(p, forecast + _ABOVE * (1.0 - forecast)) if taken else p)


@kernel
def p_full(forecast: float, count: float, capacity: float, age: float) -> float:
    """Return P(a counted facility is full) some time, `age` mean stays, after its count was taken.

    Each car leaves at rate 1 and new ones come as fast as they would fill the facility on average, so the count
    reverts to its mean: it is binomial of what stays, e^-age, plus Poisson of what has come. Its law is taken as
    normal, and the normal one as logistic (error below 0.01); the mean is the one at which a facility is full as often
    as the forecast says. At age 0 the count decides, and in the long run the forecast.
    """
    forecast = min(max(forecast, worlds.MIN_PROBABILITY), worlds.MAX_PROBABILITY)
    z = math.log(forecast / (1.0 - forecast)) / _LOGISTIC
    root = 0.5 * (z + math.sqrt(z * z + 4.0 * (capacity - 0.5)))
    stay = math.exp(-age)
    mean = count * stay + root * root * (1.0 - stay)
    variance = (1.0 - stay) * (count * stay + root * root)
    above = mean - capacity + 0.5
    if variance <= 0.0 or abs(above) > _SURE * math.sqrt(variance):
        return 1.0 if above > 0.0 else 0.0
    return 1.0 / (1.0 + math.exp(-_LOGISTIC * above / math.sqrt(variance)))


@inlined
def publish_count(counted: Any, time: float) -> None:
    """Publish the count of a facility as of the last time when that was due; call before it changes."""
    if counted.delay_s == 0.0:
        counted.published = counted.n_cars
    elif math.floor(time / counted.delay_s) > counted.period:
        counted.published, counted.period = counted.n_cars, math.floor(time / counted.delay_s)
