"""Help pages, hints, completion and the start of the command line; what commands do is tested elsewhere."""

import errno
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from annotated_types import Ge
from command_line import PARKENV, parkenv, refused

from parkenv import InputError
from parkenv.cli import COMMANDS as LISTED
from parkenv.cli import app
from parkenv.cli.command import command_class
from parkenv.cli.options import field_options, spec_of
from parkenv.envs.sensors import SearchSensorsEnv
from parkenv.files.known_names import SCENARIO_NAMES, WEATHERS, RigName
from parkenv.studies.compare.comparison import LEVELS
from planners.names import AGENTS
from sim_sensors.camera.weather import PRESETS
from sim_sensors.rig import RIG_NAMES


def commands(command=None, path=()):
    """Yield every command with its words."""
    command = command or typer.main.get_command(app)
    for name, its in getattr(command, "commands", {}).items():
        yield from commands(its, (*path, name))
    if not hasattr(command, "commands"):
        yield pytest.param(path, command, id=" ".join(path))


COMMANDS = {" ".join(one.values[0]): one.values[1] for one in commands()}


@pytest.mark.parametrize(("path", "command"), [*commands()])
def test_a_help_page_says_what_a_newcomer_needs(path, command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    page = parkenv(*path, "--help").stdout
    assert max(map(len, page.splitlines())) <= 80
    assert not re.search(r"<\w+>|INTEGER|RANGE|\[x|[{}]", page)
    for option in command.params:
        if option.param_type_name == "option":
            assert option.help, option.name
            told = option.is_flag or option.required or option.default is not None
            assert told or "[default: " in option.help or option.name in OPTIONAL, option.name
    examples = page.partition("Examples:\n")[2].partition("\n\n")[0]
    assert examples
    for line in examples.replace("\\\n      ", " ").splitlines():
        name, *words = shlex.split(line)
        assert name == "parkenv"
        its = next(c for c in (" ".join(words[:2]), words[0]) if c in COMMANDS)
        known = {opt for p in COMMANDS[its].params for opt in (*p.opts, *p.secondary_opts)}
        assert {word for word in words if word[0] == "-"} <= known


OPTIONAL = (
    "address", "agents", "around", "bounds", "calibrated", "car_park", "crops", "drives", "lot",
    "constant_forecast", "model", "labels", "picture", "replay", "rig", "scenario", "simulated", "uiuc",
)  # fmt: skip
"""Options that do nothing unless they are given."""


def test_an_option_means_the_same_everywhere():
    """A short form belongs to one option."""
    short = {}
    for command in COMMANDS.values():
        for option in command.params:
            for form in option.opts:
                if len(form) == 2 and option.param_type_name == "option":
                    short.setdefault(form, set()).add(option.opts[0])
    assert short == {"-n": {"--episodes"}, "-o": {"--out"}, "-j": {"--jobs"}}


@pytest.mark.parametrize("entry", [entry for entry in LISTED.values() if entry.source])
def test_a_number_out_of_its_range_is_refused_by_every_command(entry):
    for option in field_options(command_class(entry.source)):
        if any(field.is_required() for field in option.model.model_fields.values()):
            continue  # what is missing is said first
        bounds = [mark.ge for mark in option.field.metadata if isinstance(mark, Ge)]
        if bounds and option.option.parse is None:
            with pytest.raises(InputError, match=rf"^{option.name} is -?[\d.]+, want a number of at least"):
                spec_of(option.model, {option.name: str(bounds[0] - 1)})


def test_names_are_those_of_the_modules_behind_them_and_listed_in_help():
    assert tuple(PRESETS) == WEATHERS
    assert set(RigName.__args__) == set(RIG_NAMES)
    page = parkenv("compare", "--help").stdout.replace("\n", " ")
    for name in (*AGENTS, *SCENARIO_NAMES):
        assert name in re.sub(r"- +", "-", page)


TABLE = Path(__file__).with_name("refusals.txt").read_text().splitlines()
REFUSALS = [line.split(" => ") for line in TABLE[1:]]


@pytest.mark.parametrize(("words", "said"), REFUSALS, ids=[words for words, _ in REFUSALS])
def test_a_mistake_is_answered_by_what_was_meant(words, said, tmp_path):
    (tmp_path / "odd.json").write_text("{}")
    assert said in refused(*shlex.split(words), cwd=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["odd.json"]


def test_without_words_it_says_where_to_start():
    done = parkenv()
    assert (done.returncode, "Start here:" in done.stdout) == (2, True)


COMPLETIONS = {
    "parkenv compare --scenario ca": ["campus"],
    "parkenv compare --agents mdp,be": ["mdp,belief", "mdp,belief-rivals"],
    "parkenv compare --figu": ["--figures"],
    "parkenv compare --rig st": ["stereo"],
    "parkenv benchmark run v3 --agents be": ["belief", "belief-rivals"],
    "parkenv plan --sensor-model las": ["laser"],
    "parkenv survey --weather r": ["rain"],
    "parkenv run examples/courtyard/s": ["examples/courtyard/sweep.toml"],
    "parkenv lot sh": ["show"],
    "parkenv report here --rep": ["--replay"],
}
HELPED = ("compare", "train", "lot import", "evaluate-detector", "report", "park")
FRESH = """
import contextlib, io, json, os, sys
heavy = "pydantic", "numba", "scipy", "rich", "torch", "matplotlib", "cv2", "shapely"
answers = []
from parkenv.__main__ import main
for words, variables in json.loads(sys.argv[1]):
    sys.argv = ["parkenv", *words]
    os.environ.update(variables)
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        main()
    answers.append((said.getvalue().split("\\n")[:-1], [name for name in heavy if name in sys.modules]))
print(json.dumps(answers))
"""


@pytest.fixture(scope="module")
def answers():
    """Lines that calls print, and the large modules that are loaded after each, in one process of their own."""
    calls = [((option,), {}) for option in ("--version", "--help")]
    calls += [((*name.split(), "--help"), {}) for name in HELPED]
    shell = {"_PARKENV_COMPLETE": "complete_bash"}
    calls += [((), shell | {"COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}) for line in COMPLETIONS]
    program = [sys.executable, "-c", FRESH, json.dumps(calls)]
    done = subprocess.run(program, capture_output=True, text=True, timeout=120, check=True)
    return dict(zip(("--version", "--help", *HELPED, *COMPLETIONS), json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("line", COMPLETIONS)
def test_values_are_completed_without_loading_anything_large(line, answers):
    # Options are fields, which pydantic reads.
    assert answers[line] == [COMPLETIONS[line], ["pydantic"]]


@pytest.mark.parametrize("name", HELPED)
def test_help_loads_the_options_of_its_command_alone(name, answers):
    assert answers[name][1] == ["pydantic"]


def test_version_and_help_load_nothing_large(answers):
    assert answers["--version"] == [["parkenv 0.1.0"], []]
    page, loaded = answers["--help"]
    assert loaded == []
    assert {line.split()[0] for line in page if line.startswith("  ")} >= {"demo", "compare", "lot", "schema"}


@pytest.mark.parametrize(
    ("given", "levels", "blind"),
    [
        ({"--failure-cost": "sweep"}, (), True),
        ({"--failure-cost": "sweep", "--occupancy-levels": "0.9"}, (0.9,), True),
        ({"--occupancy-levels": "none"}, (), False),
        ({}, LEVELS, False),
    ],
)
def test_a_sweep_keeps_the_levels_that_are_given(given, levels, blind):
    grid = command_class("compare").of({"--scenario": "mini", **given}).study.grid
    assert (grid.occupancy_levels, grid.blind) == (levels, blind)


def test_the_rig_of_a_scenario_file_is_that_of_its_environments(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text('lot = "mini"\nrig = "stereo"\n')
    assert SearchSensorsEnv(str(file)).rig.stereo_cameras
    assert SearchSensorsEnv(str(file), rig="laser").rig.lasers


def test_a_command_names_the_extra_that_it_lacks():
    code = "import sys; sys.modules['stable_baselines3'] = None; from parkenv.__main__ import main; main()"
    words = ("train", "ppo", "--scenario", "mini", "--steps", "100", "--trainings", "1", "--jobs", "1")
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert "parkenv[rl]" in done.stderr


def failing(error):
    def fail(*_, **__):
        raise error

    return fail


@pytest.mark.parametrize("error", [KeyError("x\ny"), RecursionError("deep"), OSError(errno.EIO, "broken")])
def test_an_unforeseen_error_is_one_line_and_a_file(monkeypatch, error):
    monkeypatch.setattr("parkenv.lots.load_lot", failing(error))
    ended = parkenv("lot", "show", "mini")
    assert (ended.returncode, ended.stderr.count("\n")) == (70, 1)
    told = rf"parkenv: error: unforeseen {type(error).__name__}: .*report it with (\S+\.txt)\n"
    found = re.search(told, ended.stderr)
    assert "in fail" in Path(found[1]).read_text()
    Path(found[1]).unlink()


def test_a_full_disk_is_no_error_of_ours(monkeypatch):
    monkeypatch.setattr("parkenv.lots.load_lot", failing(OSError(errno.ENOSPC, "No space left on device")))
    ended = parkenv("lot", "show", "mini")
    assert (ended.returncode, ended.stderr) == (2, "parkenv: error: No space left on device\n")


@pytest.mark.parametrize(
    "words",
    [("plan", "--occupancy", "log\udcff.csv"), ("compare", "--out", "\udcff"), ("\ud800",)],
    ids=("file", "folder", "command"),
)
def test_what_is_not_utf_8_on_the_command_line_is_refused(tmp_path, words):
    """Such as the name of a file from another system; summaries could not name it, and reports not read them."""
    ended = parkenv(*words, cwd=tmp_path)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr == f"parkenv: error: {words[-1]!a} on the command line is not UTF-8\n"
    assert not list(tmp_path.iterdir())


def test_closed_streams_and_readers_that_end_do_not_stop_a_command(tmp_path):
    shown = tmp_path / "mini.png"
    command = shlex.join([*PARKENV, "lot", "show", "mini", "--out", str(shown)])
    assert subprocess.run(f"{command} >&- 2>&-", shell=True).returncode == 0
    assert shown.exists()
    words = [*PARKENV, "schema", "compare"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        complaints = process.stderr.read()
    assert (process.returncode, complaints) == (1, b"")
