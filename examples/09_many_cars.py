"""Many cars in one lot: three kinds of drivers compete for slots; a table, and a film from above.

It takes a few seconds.
"""

import sys
from pathlib import Path

import numpy as np

from parkenv import make_agent
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.show.figures.picture_files import save_film
from parkenv.show.frames.fleet import FleetRenderer
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, PoissonArrivals
from planners.heuristics import POLICIES

FILM_S, FRAMES_PER_S = 90, 15

# From nine o'clock on, a car arrives every twelve seconds, on average. It stays for half an hour; if it has found no
# slot after a quarter of an hour, it goes elsewhere.
demand = Demand(
    PoissonArrivals(per_hour=300, start_s=9 * 3600, end_s=9.25 * 3600),
    stay=ExponentialTime(1800),
    patience=ConstantTime(900),
)
drivers = {
    "mdp, own observations": DriverKind(weight=0.3),
    "greedy-drive, own observations": DriverKind(weight=0.4, policy=POLICIES["greedy-drive"]),
    "greedy-drive, guided": DriverKind(weight=0.3, policy=POLICIES["greedy-drive"], knows="reserve"),
}
# A car that parks or leaves blocks its lane for six seconds, so there are queues. Cars that know the lot to be full
# search on, instead of giving up at once.
fleet = Fleet("campus", demand, drivers=list(drivers.values()), manoeuvre_s=6.0, leave_full_lot=False)
agents = [make_agent("mdp", fleet.scenario), None, None]

found = {name: [] for name in drivers}
for seed in range(3):
    fleet.reset(seed)
    fleet.run(agents)
    for kind, name in enumerate(drivers):
        found[name].append(fleet.cars["total_s"][fleet.cars["kind"] == kind].mean())
for name, values in found.items():
    print(f"{name:32} {np.mean(values):6.0f} s")

if len(sys.argv) > 1:  # the name of a film, such as fleet.gif
    film, renderer = Path(sys.argv[1]), FleetRenderer(fleet)
    fleet.reset(11)
    frames = []
    for second in np.arange(600.0, 600.0 + FILM_S, 0.5):
        fleet.run(agents, until=fleet.begin + second)
        frames.append(renderer.frame())
    save_film(frames, film, fps=FRAMES_PER_S, colors=48)
    print(film)
