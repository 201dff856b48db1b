"""A lot of your own: describe it in metres, save it as GeoJSON, and search there.

It takes a few seconds.
"""

import tempfile
from pathlib import Path

import numpy as np

from parkenv import Lane, Mouth, ParkingLot, make_scenario
from parkenv.lots import read_lot, write_lot
from parkenv.studies.compare.cases import Case

# Twelve slots on either side of one aisle that runs east; cars stand nose-in, so they are entered at the rear.
x = 6.0 + 2.5 * np.arange(12)
lot = ParkingLot(
    name="yard",
    slot_ids=tuple(f"{side}{i}" for side in "NS" for i in range(12)),
    slot_xy=np.concatenate([np.stack([x, 0 * x + 5.5], axis=1), np.stack([x, 0 * x - 5.5], axis=1)]),
    slot_yaw=np.repeat([np.pi / 2, -np.pi / 2], 12),
    slot_length=np.full(24, 5.0),
    slot_width=np.full(24, 2.5),
    slot_mouth=np.full(24, Mouth.REAR),
    lanes=(Lane([[0.0, 0.0], [40.0, 0.0]]),),
    entries=[[0.0, 0.0]],
    goals=[[45.0, 10.0]],
)
with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "yard.geojson"
    write_lot(lot, file)
    assert read_lot(file) == lot

scenario = make_scenario(lot)
for agent in ("mdp", "greedy-goal", "greedy-drive", "oracle"):
    rows = Case(scenario, agent).run(range(50))
    print(f"{agent:13s} {np.mean([row['total_s'] for row in rows]):6.1f} s")
