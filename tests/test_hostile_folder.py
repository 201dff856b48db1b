"""Nothing that lies in the working folder runs, or sets how the command works."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from command_line import PARKENV

from parkenv import make_scenario
from parkenv.show.figures.fleet import CarParkDays, save_counted_demand
from parkenv.show.figures.forecast import save_rates
from parkenv.show.figures.lot import save_lot_picture

COMMAND = [PARKENV[0], "-P", *PARKENV[1:]]
"""The command as it is installed: Python does not look for modules in the working folder."""


MODULES = (
    "pickle", "socket", "queue", "numpy", "numba", "yaml", "cloudpickle", "sitecustomize", "parkenv", "matplotlib",
)  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    """A folder with modules that leave a mark, and settings of libraries that stop or mislead them."""
    ran = tmp_path / "ran"
    for name in MODULES:
        (tmp_path / f"{name}.py").write_text(f"open({str(ran)!r}, 'a').write({name!r})")
    (tmp_path / ".numba_config.yaml").write_text(f"cache_dir: {tmp_path / 'theirs'}\ndisable_jit: 1\n")
    (tmp_path / "matplotlibrc").write_bytes(b"text.usetex: True\n\xff\xfe\n")
    return tmp_path


PATIENT = """
import numpy as np
from parkenv.world.lot import PARK
from planners.agent import SearchAgent


class Patient(SearchAgent):
    name = "patient"

    def begin(self, observation, belief):
        return np.random.default_rng(0)

    def decide(self, observation, belief, memory):
        return int(memory.choice(np.nonzero(observation["action_mask"])[0]))
"""


@pytest.mark.slow
def test_a_comparison_with_workers_and_figures_takes_a_users_class_and_nothing_else_from_the_folder(folder):
    (folder / "my_agents.py").write_text(PATIENT)
    words = (
        "compare --scenario mini --agents my_agents:Patient,first-free -n 2 --jobs 2 --occupancy-levels none"
    )
    done = subprocess.run(
        [*COMMAND, *words.split(), "--out", "out", "--report"], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert ",patient," in (folder / "out" / "episodes.csv").read_text()
    assert (folder / "out" / "report.html").is_file()
    assert not (folder / "ran").exists()
    assert not (folder / "theirs").exists()


def test_a_users_class_is_found_after_everything_else(folder):
    (folder / "mine.py").write_text("import colorsys\nclass A:\n    def predict(self): ...\n")
    (folder / "colorsys.py").write_text(f"open({str(folder / 'ran')!r}, 'a').write('colorsys')")
    code = (
        "from parkenv.files.user_class import load_class as load; print(load('mine:A', 'agent', 'predict'))"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=folder, capture_output=True, text=True)
    assert done.stdout == "<class 'mine.A'>\n", done.stderr
    assert not (folder / "ran").exists()


@pytest.mark.parametrize(
    ("command", "number", "code"),
    [(["-m", "parkenv"], signal.SIGINT, 130), (["parkenv"], signal.SIGTERM, 143)],
)
def test_a_signal_before_anything_is_imported_ends_the_command(tmp_path, command, number, code):
    (tmp_path / "gymnasium.py").write_text(
        f"import os, time\nos.kill(os.getpid(), {number:d})\ntime.sleep(9)\n"
    )
    (tmp_path / "parkenv").write_text("from parkenv.__main__ import main\nmain()\n")
    path = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, *command, "--version"],
        cwd=tmp_path, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path},
        # The tests themselves may run where Ctrl-C is ignored, such as in the background.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


def test_an_import_changes_no_settings_of_a_users_own_process(folder):
    (folder / "matplotlibrc").write_text("text.usetex: True\n")
    for module in folder.glob("*.py"):
        module.unlink()
    code = (
        "import sys, os, parkenv\n"
        "loaded = {'numba', 'matplotlib'} & set(sys.modules)\n"
        "import matplotlib\n"
        "print(loaded, matplotlib.rcParams['text.usetex'], os.environ.get('PYTHONSAFEPATH'))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)
    assert done.stdout == "set() True None\n", done.stderr


def test_figures_have_one_style_whatever_the_users_settings_are(tmp_path):
    scenario, three = make_scenario("mini"), np.ones(3)
    days = CarParkDays("a $ in a name", 10.0, three, three, np.ones((2, 3)))
    pictures = []
    for settings in ({"text.usetex": True, "savefig.facecolor": "red", "lines.linewidth": 9.0}, {}):
        with mpl.rc_context(settings):
            save_rates(scenario.occupancy, tmp_path / "rates.png", title="mini")
            save_counted_demand([days], np.arange(9.0, 12.0), tmp_path / "days.png")
            save_lot_picture(scenario.lot, tmp_path / "lot.png")
        pictures.append([path.read_bytes() for path in sorted(tmp_path.glob("*.png"))])
    assert pictures[0] == pictures[1]
