"""The films of the environments' pages: `python docs/films.py [NAME ...]` makes them in docs/pictures."""

import sys
from pathlib import Path

import cv2
import gymnasium as gym
import numpy as np

import parkenv  # noqa: F401  registers the environments
from parkenv.show.colors import PALETTE
from parkenv.show.figures.picture_files import save_film
from parkenv.show.painters.opencv import MapView, paint
from parkenv.show.scene import DISC, Areas, Lines, LotScene, Marks, cars, posed
from planners import make_agent
from planners.driving.parking import ParkingAgent


def episode(env, agent, seed, every=1):
    """Film an episode, a frame for some steps, and how it ends."""
    observation, _ = env.reset(seed=seed)
    frames, memory, over, steps = [env.render()], None, False, 0
    while not over:
        action, memory = agent.predict(observation, memory)
        observation, _, terminated, truncated, _ = env.step(action)
        over, steps = terminated or truncated, steps + 1
        if over or steps % every == 0:
            frames.append(env.render())
    return frames + frames[-1:] * 12


def search(seed=0):
    """Film a search."""
    env = gym.make("parkenv/Search-v2", scenario="campus", render_mode="rgb_array")
    return episode(env, make_agent("belief", env.unwrapped.scenario), seed)


def search_vector():
    """Film nine searches of a batch, each in its own world, side by side."""
    films = [[cv2.resize(f, (280, 210), interpolation=cv2.INTER_AREA) for f in search(i)] for i in range(9)]
    now = [[film[min(t, len(film) - 1)] for film in films] for t in range(max(map(len, films)))]
    return [np.vstack([np.hstack(frames[i : i + 3]) for i in (0, 3, 6)]) for frames in now]


def search_sensors():
    """Film what the car measures: the camera's picture, and the ends of the laser's beams from above."""
    env = gym.make("parkenv/SearchSensors-v2", scenario="campus", weather="sunny", captures=1)
    scene, (_, model, mount) = LotScene.of(env.unwrapped.scenario.lot), env.unwrapped.rig.lasers[0]
    slots = Lines(list(scene.slot_lines), "paint", 0.12)
    image = np.full((300, 400, 3), PALETTE["ground"], np.uint8)

    def picture(observation):
        pose, ranges = observation["pose"][0].astype(float), observation["scan.laser"][0]
        x, y, yaw = mount.in_world(pose)
        hit = ranges < model.max_range
        ends = [x, y] + ranges[hit, None] * np.stack(
            [f(model.angles[hit] + yaw) for f in (np.cos, np.sin)], axis=1
        )
        above = image.copy()
        layers = [Areas(scene.paved(pose[:2], 30.0), "floor"), slots, *cars(pose[None], "car", edge="ink")]
        paint(
            above,
            MapView.around(pose[:2], (400, 300), 9.0),
            [*layers, Marks(posed(ends), DISC, "parked", px=3.5)],
        )
        both = np.hstack([observation["image.right"][0], above])
        return cv2.resize(both, (560, 210), interpolation=cv2.INTER_AREA)

    frames = [picture(env.reset(seed=0)[0])]
    return frames + [picture(env.step(3)[0]) for _ in range(25)]  # 3: to the right


def drive():
    """Film a planner that parks in a slot of each kind."""
    frames = []
    for kind, lot, seed in (
        ("oblique", "campus", 3),
        ("parallel", "street", 1),
        ("perpendicular", "campus", 5),
    ):
        env = gym.make("parkenv/Drive-v1", lot=lot, kinds=(kind,), obstacle_map=True, render_mode="rgb_array")
        frames += episode(env, ParkingAgent(env.unwrapped.vehicle), seed, every=5)
    return frames


FILMS = {
    "search": (search, 6), "search-vector": (search_vector, 6), "search-sensors": (search_sensors, 4),
    "drive": (drive, 10),
}  # fmt: skip

if __name__ == "__main__":
    for name in sys.argv[1:] or FILMS:
        film, fps = FILMS[name]
        save_film(film(), Path(__file__).parent / "pictures" / f"env_{name}.gif", fps=fps, colors=128)
