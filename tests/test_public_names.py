"""What `import parkenv` gives, and what it leaves alone."""

import inspect
import pydoc
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import FunctionType

import pytest

import parkenv
from parkenv.lots.local_frame import LocalFrame

ROOT = Path(__file__).parents[1]
REFERENCE = "\n".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md"))
PAGE = (ROOT / "docs" / "api" / "index.md").read_text(encoding="utf-8")


def test_public_names_are_those_of_the_page_and_exist():
    listed = PAGE.partition("Classes of these names:")[2]
    assert set(re.findall(r"`(\w+)`", listed)) == set(parkenv.__all__) == set(parkenv._EXPORTS)
    for name in parkenv.__all__:
        assert getattr(parkenv, name).__name__ == name


@pytest.mark.parametrize("name", re.findall(r"^::: (\S+)", REFERENCE, re.M))
def test_the_reference_documents_every_member(name):
    thing = pydoc.locate(name)
    own = vars(thing).items() if inspect.isclass(thing) else ()
    methods = [
        m for m, what in own if isinstance(what, FunctionType | classmethod | property) and m[0] != "_"
    ]
    assert inspect.getdoc(thing)
    assert [member for member in methods if not inspect.getdoc(getattr(thing, member))] == []


def test_import_changes_no_signal_handler_and_loads_no_study():
    program = (
        "import signal, sys; before = [signal.getsignal(n) for n in signal.valid_signals()]; import parkenv\n"
        "assert before == [signal.getsignal(n) for n in signal.valid_signals()]\n"
        "assert not {'pydantic', 'numba', 'planners', 'parkenv.studies'} & set(sys.modules)"
    )
    # The name of the program makes no difference.
    subprocess.run(
        [sys.executable, "-c", f"import sys; sys.argv = ['parkenv']; {program}"], check=True, timeout=60
    )


def test_a_comparison_needs_no_folder_and_knows_its_fields():
    agents = ["first-free", "greedy-goal"]
    result = parkenv.compare(scenarios=["mini"], agents=agents, episodes=2, jobs=1, figures=False)
    assert {row["agent"] for row in result.rows} == set(agents)
    assert result.complete
    with pytest.raises(parkenv.InputError, match=r"unknown key 'episods'; did you mean 'episodes'"):
        parkenv.compare(episods=3)


def test_the_command_lets_ctrl_c_end_it_before_it_imports_its_modules():
    program = (
        "import os, signal, sys, types; from parkenv.__main__ import main\n"
        "assert 'parkenv.cli' not in sys.modules\n"
        "command = types.ModuleType('parkenv.cli')\n"
        "command.main = lambda: os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.modules['parkenv.cli'] = command; signal.signal(signal.SIGINT, signal.default_int_handler); main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stderr) == (130, "")


def test_what_needs_an_extra_says_so_in_a_line(monkeypatch, tmp_path):
    for module in ("pyproj", "yaml", "sklearn.cluster", "osmium"):
        monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / "map.yml").write_text("PARKING_AREAS:\n")
    (tmp_path / "map.osm.pbf").write_bytes(b"")
    for needs in (
        lambda: LocalFrame(7.85, 48.0).to_xy([[7.85, 48.0]]),
        lambda: parkenv.load_lot(tmp_path / "map.yml"),
        lambda: parkenv.import_lot(tmp_path / "map.osm.pbf"),
    ):
        with pytest.raises(parkenv.InputError, match=r'needs the extra osm: pip install "parkenv\[osm\]"'):
            needs()


def test_the_two_commands_of_the_readme_need_few_packages():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert len(project["dependencies"]) <= 17
