"""The occupancy of the packaged scenario `kerbs`, in seconds: `python examples/streets_v1/kerb_process.py OUT.json`.

It follows `kerbs_law.json`, which `kerb_statistics.py` wrote. What real kerbs have and this process has not: profiles
by hour that differ between streets, days that differ for one street alone, and stays with a heavy tail.
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

import parkenv
from parkenv.lots import packaged_lot
from parkenv.world.occupancy.process import OccupancyProcess

LAW = Path(parkenv.__file__).parent / "scenarios" / "packaged" / "kerbs_law.json"
NIGHT = range(7)  # hours


def kerb_process(lot, law):
    """Create the occupancy of the district from the law, a dict as in `kerbs_law.json`."""
    rng = np.random.default_rng(52)
    kerb = {facility.name: k for k, facility in enumerate(lot.facilities)}
    face = np.array([kerb[name] for name in lot.slot_facility])
    # A face has half of the effects of the two crossings it is between, and its own: opposite faces share both, the
    # next ones on the street one, farther ones none.
    shared, crossing, effect = law["opposite_correlation"], {}, []
    for name in kerb:
        street, block, _ = name.split(", ")
        ends = [(street, int(block.split()[1]) + k) for k in (0, 1)]
        of_ends = sum(crossing.setdefault(end, rng.normal()) for end in ends) * np.sqrt(shared / 2)
        effect.append(law["between_faces"] * (of_ends + np.sqrt(1.0 - shared) * rng.normal()))
    popularity = np.array(effect)[face] + rng.normal(0.0, law["between_bays"], lot.n_slots)
    leaving = np.exp(rng.normal(0.0, law["between_stays"], len(kerb)) - law["between_stays"] ** 2 / 2)[face]
    night = np.isin(np.arange(168) % 24, NIGHT)
    departures = 1.0 / (60.0 * np.where(night, law["night_stay_min"], law["stay_min"]))
    hours = law["share_taken"]
    wanted = np.array(5 * hours["weekday"] + hours["saturday"] + hours["sunday"])
    return _followed(popularity, leaving, departures, (wanted + np.roll(wanted, -1)) / 2)


def _followed(popularity, leaving, departures, wanted):
    """Return the process whose mean at the end of each hour is as wanted, as far as cars leave fast enough."""
    p, arrivals = np.full(popularity.size, wanted[-1]), np.zeros(168)
    for hour in (*range(144, 168), *range(168)):

        def excess(logit, p=p, hour=hour):
            odds = np.exp(popularity + logit)
            decay = np.exp(-3600.0 * departures[hour] * leaving * (1.0 + odds))
            after = odds / (1.0 + odds) * (1.0 - decay) + p * decay
            return after.mean() - wanted[hour], after

        falls_too_fast = excess(-30.0)[0] >= 0.0
        logit = -30.0 if falls_too_fast else brentq(lambda x, of=excess: of(x)[0], -30.0, 30.0)
        arrivals[hour], p = np.exp(logit) * departures[hour], excess(logit)[1]
    digits = "{:.6g}".format
    rounded = (np.exp(popularity) * leaving, arrivals, leaving, departures)
    return OccupancyProcess(*(np.array([float(digits(value)) for value in values]) for values in rounded))


if __name__ == "__main__":
    law = json.loads(LAW.read_text(encoding="utf-8"))
    kerb_process(packaged_lot("kerbs"), law).to_file(sys.argv[1])
