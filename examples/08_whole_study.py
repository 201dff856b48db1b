"""A whole study: does a map that other drives made help, and does better planning on it help more?

A lot of one's own, surveyed through simulated sensors on three days; then agents search there on new days: with the
map, and with a map that says of every slot that half of the time it is taken. All meet the same cars.
It takes about half a minute; a line says when the survey begins, and when the searches do.
"""

import tempfile
from pathlib import Path

import numpy as np

from parkenv import make_scenario
from parkenv.lots import grid_lot
from parkenv.mapping.learned_map import map_prior
from parkenv.mapping.store import MapStore
from parkenv.mapping.survey import Survey, SurveySettings
from parkenv.studies.compare.cases import Case
from parkenv.studies.sensing.surveys import session_row, summarize
from parkenv.studies.statistics import mean_interval
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import ConstantForecast

lot = grid_lot(4, 20)
world = make_scenario(lot, arrival=ArrivalWindow.parse("11:00-13:00"))
print(f"{lot.n_slots} slots; surveying on 3 days ...", flush=True)

with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "map.sqlite"
    survey = Survey(world, SurveySettings(every=2.5, windows=(world.arrival,), seed=1))
    drives = [survey.drive(number) for number in range(3)]
    with MapStore(file, lot) as store:
        for drive in drives:
            store.add(drive.session)
        log = store.log()
    rows = [session_row(drive) for drive in drives]
    surveyed = summarize(world, survey.settings, rows, file)
found, right = surveyed["car_detection_rate"], surveyed["slot_accuracy"]
print(f"3 drives: {found:.1%} of the cars found, {right:.1%} of the slots judged right")

maps = {
    "no map": ConstantForecast(0.5, world.occupancy),
    "3 drives": map_prior(log, (), lot.walk_m(world.goal)),
    "the truth": None,
}
print("searching ...", flush=True)
totals = {}
for name, prior in maps.items():
    for agent in ("first-free", "mdp", "belief"):
        rows = Case(world.replace(prior=prior), agent).run(range(100, 200))
        totals[name, agent] = np.array([row["total_s"] for row in rows])

print("\nseconds from the entry to the goal     (difference to mdp without a map, same worlds)")
for (name, agent), seconds in totals.items():
    mean, low, high = mean_interval(seconds - totals["no map", "mdp"])
    print(f"{name:10s} {agent:11s} {seconds.mean():6.1f}     {mean:+6.1f} [{low:+.1f}, {high:+.1f}]")
