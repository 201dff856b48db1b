"""The simulated sensors without a parking lot: three cars, a wall, a camera and a laser.

It takes a few seconds.
"""

from pathlib import Path

import matplotlib as mpl
import numpy as np

from sim_sensors.camera.models import PinholeCamera
from sim_sensors.camera.weather import Weather
from sim_sensors.ground_truth import View, vehicle_boxes
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import RIGHT, Mount, SensorRig
from sim_sensors.scene import Scene
from sim_sensors.surroundings import Surroundings

mpl.use("agg")
from matplotlib import pyplot as plt

# x east, y north, metres; the cars stand along a wall, one of them with its nose to the lane.
scene = Scene.from_arrays(
    poses=[[-5.5, 5.0, 0.0], [0.0, 5.0, 0.03], [5.0, 5.4, -np.pi / 2]],
    seeds=[3, 14, 8],
    bodies=["estate", "van", "hatchback"],
    paints=[(120, 24, 28), (196, 200, 204), (30, 66, 120)],
    surroundings=Surroundings(
        paved=[[[-20, -4], [20, -4], [20, 9], [-20, 9]]], walls=[[-20, 9, 20, 9, 2.2]], trees=[[-9, 12, 7]]
    ),
)
rig = SensorRig(
    cameras=(("right", PinholeCamera.from_field_of_view(horizontal=1.5), Mount(z=1.3, yaw=RIGHT)),),
    lasers=(("laser", LaserScanner(), Mount(z=0.5)),),
)
pose = np.array([0.0, -2.0, np.pi])  # driving west, so that the right is north
capture = rig.capture(scene, pose, Weather.draw("sunny", 5), seed=0)

_, camera, mount = rig.cameras[0]
frame, scan = capture.images["right"], capture.scans["laser"]
boxes = vehicle_boxes(camera, scene, mount.camera_pose(pose), frame)
for name, view, away, seen in zip(boxes.ids, boxes.view, boxes.distance, boxes.visible_fraction, strict=True):
    print(f"car {name}: {View(view).name.lower()} view at {away:.1f} m, {seen:.0%} of it visible")
print(
    f"the laser met something on {np.isfinite(scan).sum()} of {len(scan)} beams, at {scan.min():.2f} m nearest"
)

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), width_ratios=(1.25, 1))
left.imshow(frame.image)
left.set_axis_off()
angle = rig.lasers[0][1].angles + pose[2]
right.plot(pose[0] + scan * np.cos(angle), pose[1] + scan * np.sin(angle), ".", markersize=2)
right.plot(*pose[:2], "k^")
right.set_aspect("equal")
right.set(xlabel="x, m", ylabel="y, m", title="scan at knee height")
figure.tight_layout()
folder = Path("results")
folder.mkdir(exist_ok=True)
figure.savefig(folder / "sensors_alone.png", dpi=110)
print(f"wrote {folder / 'sensors_alone.png'}")
