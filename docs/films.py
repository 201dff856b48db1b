"""The films of the environments' pages and of the game: `python docs/films.py [NAME ...]` makes them in docs/pictures.

The game and the map of the town are shown in Chromium, driven by selenium (extra dev).
"""

import io
import json
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import cv2
import gymnasium as gym
import numpy as np

import parkenv  # noqa: F401  registers the environments
from parkenv.show.figures.picture_files import save_film
from parkenv.show.painters.opencv import MapView, paint
from parkenv.show.scene import DISC, PALETTE, Areas, Lines, LotScene, Marks, cars, posed
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
        pose, ranges = observation["pose"][0].astype(float), observation["scan_laser"][0]
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
        both = np.hstack([observation["image_right"][0], above])
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


CLOCK = """
let now = 0, waiting = [];
performance.now = () => now;
window.requestAnimationFrame = f => waiting.push(f);
window.pass = ms => { now += ms; const due = waiting; waiting = []; due.forEach(f => f(now)); };
"""
SHOWN = 'document.querySelector("#result").getClientRects().length'
TAP = """
const game = document.querySelector("#lot"), to = {pointerId: 1, clientX: arguments[0], clientY: arguments[1]};
for (const name of ["pointerdown", "pointerup"]) game.dispatchEvent(new PointerEvent(name, {...to, bubbles: true}));
"""


@contextmanager
def browser_at(width, height, folder):
    """A headless Chromium with a window of this size, px; its profile is in a folder."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}/profile"):
        options.add_argument(flag)
    with webdriver.Chrome(options=options) as browser:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        yield browser


def shot(browser):
    """What is in the window, (h, w, 3)."""
    from PIL import Image

    return np.array(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB"))


def play(targets=("C10", "A19", "A19")):
    """Film a game in which a person goes to some slots, parks in the last one, and sees the agents' drives."""
    with tempfile.TemporaryDirectory() as folder:
        page, frames = Path(folder) / "play.html", []
        subprocess.run(
            ["parkenv", "play", "--html", "--worlds", "10", "--seed", "5", "--out", page], check=True
        )
        with browser_at(1040, 600, folder) as browser:
            # The page's clock stands still between frames.
            browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": CLOCK})
            browser.get(page.as_uri())

            def ask(script, *values):
                return browser.execute_script(f"return {script}", *values)

            def shoot(n=1):
                for _ in range(n):
                    for _ in range(2):
                        browser.execute_script("pass(50)")
                    frames.append(shot(browser))

            def shoot_until(script, most=160):
                for _ in range(most):
                    shoot()
                    if ask(script):
                        return

            lot = json.loads(ask('document.querySelector("#game-data").textContent'))["problem"]["lot"]
            corner = ask('(r => [r.x, r.y])(document.querySelector("#lot").getBoundingClientRect())')
            shoot(8)
            for target in targets:
                ring = lot["slots"][lot["slot_ids"].index(target)]
                x, y = ask("game.toPixels(arguments[0])", [(ring[0] + ring[4]) / 2, (ring[1] + ring[5]) / 2])
                browser.execute_script(TAP, corner[0] + x, corner[1] + y)
                shoot(2)
                shoot_until(f'document.querySelector("#lot").dataset.steps || {SHOWN}')
                shoot(3)
            shoot_until('document.querySelector("#result .play").ariaLabel == "Play"')
            shoot(8)
    return frames


ONLY_MAP = """
const others = ".bar, .head, .controls, h2, main > section:not(#town), .legend, .keys, .zooms, .small";
for (const element of document.querySelectorAll(others)) element.remove();
document.querySelector("main").style.padding = "0.7rem";
document.documentElement.style.overflow = "hidden";
window.dispatchEvent(new Event("resize"));
"""
GO_TO = """
const slider = document.querySelector("#town input[type=range]");
slider.value = arguments[0];
slider.dispatchEvent(new Event("input"));
return Number(slider.max);
"""


def town():
    """Film the map of a day in the town, a frame for every quarter of an hour."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["fleet", "--scenario", "town", "--agents", "usual", "--knows", "own", "-n", "1"]
        subprocess.run(["parkenv", *command, "--out", f"{folder}/town"], check=True)
        with browser_at(1040, 730, folder) as browser:
            browser.get(Path(folder, "town/fleet.html").as_uri())
            browser.execute_script(ONLY_MAP)
            end = browser.execute_script(GO_TO, 0)
            frames = []
            for second in np.arange(1800.0, end - 1799.0, 900.0):
                browser.execute_script(GO_TO, second)
                frames.append(shot(browser))
    return frames + frames[-1:] * 8


FILMS = {
    "search": (search, 6), "search-vector": (search_vector, 6), "search-sensors": (search_sensors, 4),
    "drive": (drive, 10), "play": (play, 10),
    "town": (town, 8),
}  # fmt: skip

if __name__ == "__main__":
    for name in sys.argv[1:] or FILMS:
        film, fps = FILMS[name]
        file = {"play": "play_campus.gif", "town": "town.gif"}.get(name, f"env_{name}.gif")
        save_film(film(), Path(__file__).parent / "pictures" / file, fps=fps, colors=128)
