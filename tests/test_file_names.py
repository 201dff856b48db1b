"""Names from files stay in their folder and are printed as they are; nothing that lies in the working folder runs."""

import gc
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from command_line import PARKENV, parkenv, refused
from hypothesis import given
from hypothesis import strategies as st

from parkenv import make_scenario
from parkenv.files.file_names import MAX_BYTES, distinct_names, file_name
from parkenv.lots import load_lot, write_lot
from parkenv.show.figures.fleet import CarParkDays, save_counted_demand
from parkenv.show.figures.forecast import save_rates
from parkenv.show.figures.lot import save_lot_picture

HOSTILE = "..[bold]$a_{$:b*?<|> CON.txt " + "ℵ" * 50
"""A name that scenario files may have."""
NAMES = st.sampled_from(["a", "A", "a.png", "b"])
FILES = st.builds("{}/{}.{}".format, st.sampled_from(["x", "y"]), NAMES, st.sampled_from(["png", "jpg"]))


@given(st.text(st.characters(exclude_categories=()), max_size=400))
def test_a_file_name_is_one_part_of_a_path_of_bounded_length(name):
    made = file_name(name, ".png")
    assert 4 < len(made.encode()) <= MAX_BYTES + 4
    assert not set(made) & set('\0/\\:*?"<>|')
    assert made[0] not in ". "
    assert file_name(made[:-4]) == made[:-4]


@pytest.mark.parametrize("name", ["campus", "Markt 5, Süd", "mdp(failure_s=90)", "日本", "x" * MAX_BYTES])
def test_a_plain_name_is_its_own_file_name(name):
    assert file_name(name) == name


def test_different_names_have_different_files():
    names = [
        "a/b", "a:b", "a_b", "..", ".", "", "con", "CON", "con.txt", "x" * 300, "x" * 301, "a\0b", "\ud800",
    ]  # fmt: skip
    assert len({file_name(name) for name in names}) == len(names)


@given(st.lists(FILES.map(Path), max_size=12))
def test_different_files_have_distinct_names_and_one_alone_its_stem(files):
    names = distinct_names(files)
    assert len(set(names)) == len(set(files))
    stems = [file.stem.casefold() for file in set(files)]
    if len(set(stems)) == len(stems):
        assert names == [file.stem for file in files]


def lot_named(name, path):
    write_lot(load_lot("mini"), path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"name": name}))
    return path


@pytest.mark.parametrize("name", ["../x", "x" * 300, "[bold]x[/nothing] :car: $a_{$"])
def test_a_lot_is_drawn_beside_whatever_its_name_is(tmp_path, name):
    (tmp_path / "in").mkdir()
    lot_named(name, tmp_path / "lot.geojson")
    drawn = parkenv("lot", "show", "../lot.geojson", cwd=tmp_path / "in")
    assert (drawn.returncode, drawn.stderr) == (0, "")
    (picture,) = (tmp_path / "in").iterdir()
    assert picture.name == file_name(name, ".png")
    assert "".join(name.split()) in "".join(drawn.stdout.split())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "lot.geojson"]


@pytest.mark.parametrize("name", ["a\nb\0\x1b[31mred\u202eright to left", 5])
def test_a_name_that_a_terminal_would_obey_is_refused(tmp_path, name):
    lot_named(name, tmp_path / "lot.geojson")
    said = refused("lot", "show", tmp_path / "lot.geojson")
    assert "name is " in said
    assert said.rstrip("\n").isprintable()


def test_a_path_that_a_terminal_would_obey_is_printed_escaped(tmp_path):
    checked = parkenv("lot", "check", lot_named("plain", tmp_path / "\x1b[31mred\u202e.geojson"))
    assert (checked.returncode, checked.stderr) == (0, "")
    assert r"\x1b[31mred\u202e.geojson" in checked.stdout
    assert checked.stdout.replace("\n", "").isprintable()


@pytest.mark.parametrize(
    ("command", "pictures"),
    [
        (["compare", "--agents", "greedy-drive", "--episodes", 1], ("searches", "time_distribution")),
        (["plan"], ()),
        pytest.param(["survey", "--sessions", 1, "--every", 12], ("map", "session"), marks=pytest.mark.slow),
    ],
)
def test_a_scenario_of_any_name_is_run_to_its_end(tmp_path, command, pictures):
    scenario, out = tmp_path / "in.toml", tmp_path / "out" / "run"
    scenario.write_text(f"name = '{HOSTILE}'\nlot = 'mini'\n")
    gc.collect()  # what other tests left open warns here, not in the command
    ended = parkenv(*command, "--scenario", scenario, "--out", out)
    assert (ended.returncode, ended.stderr) == (0, "")
    names = {path.name for path in out.iterdir()}
    for kind in pictures:
        assert any(n.startswith(f"{kind}_") and n.endswith(".png") for n in names), kind
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.toml", "out"]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["run"]


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
    words = "compare --scenario mini --agents my_agents:Patient,first-free -n 2 --jobs 2 --out out --report"
    command = [*COMMAND, *words.split(), "--occupancy-levels", "none"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert ",patient," in (folder / "out" / "episodes.csv").read_text()
    assert (folder / "out" / "report.html").is_file()
    assert not (folder / "ran").exists()
    assert not (folder / "theirs").exists()


def test_a_users_class_is_found_after_everything_else(folder):
    (folder / "mine.py").write_text("import colorsys\nclass A:\n    def predict(self): ...\n")
    (folder / "colorsys.py").write_text(f"open({str(folder / 'ran')!r}, 'a').write('colorsys')")
    code = "from parkenv.files.user_class import load_class; print(load_class('mine:A', 'agent', 'predict'))"
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=folder, capture_output=True, text=True)
    assert done.stdout == "<class 'mine.A'>\n", done.stderr
    assert not (folder / "ran").exists()


@pytest.mark.parametrize(
    ("command", "number", "code"),
    [(["-m", "parkenv"], signal.SIGINT, 130), (["parkenv"], signal.SIGTERM, 143)],
)
def test_a_signal_before_anything_is_imported_ends_the_command(tmp_path, command, number, code):
    dies = f"import os, time\nos.kill(os.getpid(), {number:d})\ntime.sleep(9)\n"
    (tmp_path / "gymnasium.py").write_text(dies)
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
        "import os, signal, sys\n"
        "before = [signal.getsignal(number) for number in signal.valid_signals()]\n"
        "import parkenv\n"
        "loaded = {'numba', 'matplotlib'} & set(sys.modules)\n"
        "assert before == [signal.getsignal(number) for number in signal.valid_signals()]\n"
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
