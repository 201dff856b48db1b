"""The command line; `parkenv COMMAND --help` explains each command."""

import errno
import io
import os
import re
import sys
import tempfile
import traceback
import warnings
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Annotated

import typer

from parkenv.cli.command import Entry, make_app
from parkenv.cli.stop_signals import stop_signals
from parkenv.errors import InputError, needs_extra, require
from parkenv.version import __version__
from sim_sensors.errors import SensorError

# Headings by what the reader brings; the first has what a newcomer needs.
START, AGENTS, PLACES, SENSE = (
    "Start here", "Planners and learners", "Places, counts and drivers", "Cameras, lasers and maps",
)  # fmt: skip
COMMANDS = {
    "demo": Entry("Survey a lot with simulated sensors, then search in it.", "demo", START),
    "compare": Entry("Compare agents in the same worlds.", "compare", START),
    "train": Entry("Train agents by reinforcement learning.", "train", START),
    "play": Entry("Play the search yourself, in the worlds of the agents.", "report:Play", START),
    "report": Entry("Write an HTML page on a run, with replays.", "report:Report", START),
    "run": Entry("Run an experiment file.", "run:Run", START),
    "plan": Entry(
        "Draw planned searches, as in Fig. 4.9 to 4.12 of the thesis.", "study_commands:Plan", AGENTS
    ),
    "benchmark": Entry("Run the benchmark suite, and check the results of others.", heading=AGENTS),
    "benchmark run": Entry("Run agents through all episodes of the suite.", "benchmark"),
    "benchmark check": Entry("Check results of the suite, and print them side by side.", "benchmark:Check"),
    "benchmark page": Entry("Check results of the suite, and write a page of them.", "benchmark:Page"),
    "benchmark show": Entry("Show the tasks and settings of the suite.", "benchmark:Show"),
    "park": Entry("Evaluate agents that drive the car into a slot.", "park", AGENTS),
    "calibrate": Entry("Measure the costs of searches on whole driven trips.", "calibrate", AGENTS),
    "lot": Entry("Show, check, import and convert lots.", heading=PLACES),
    "lot show": Entry("Draw a lot and summarise it.", "lot:Show"),
    "lot check": Entry(
        "List all errors and warnings of a lot file, by feature number (from 0).", "lot:Check"
    ),
    "lot import": Entry("Import a real place; report what was found, guessed and left out.", "lot:Import"),
    "lot convert": Entry("Write a lot as native GeoJSON.", "lot:Convert"),
    "occupancy": Entry("Fit models to recorded occupancy, and score forecasts.", heading=PLACES),
    "occupancy fit": Entry("Fit a model to recorded occupancy by maximum likelihood.", "occupancy:Fit"),
    "occupancy demand": Entry("Fit the demand of a town to counts of its car parks.", "demand"),
    "occupancy evaluate": Entry("Score forecasts of occupancy against simple ones.", "occupancy:Evaluate"),
    "occupancy record": Entry("Record days of a town's own demand as a log.", "occupancy:Record"),
    "fleet": Entry("Simulate many cars that search at the same time.", "fleet", PLACES),
    "commute": Entry("Simulate daily commuters with a map that learns.", "commute", PLACES),
    "curve": Entry("Fit search time and walk as functions of occupancy.", "curve", PLACES),
    "schema": Entry("Print the JSON schema of a kind of file, or write all schemas.", "run:Schema", PLACES),
    "map-drive": Entry("Make a map from a recorded drive, photographs or a film.", "sensing:MapDrive", SENSE),
    "detect": Entry("Find cars in photographs, videos and recorded drives.", "detect:Detect", SENSE),
    "survey": Entry("Drive past every slot, and map which are taken.", "survey", SENSE),
    "map": Entry("Show the predictions of a map.", "sensing:Map", SENSE),
    "sensors": Entry("Preview the simulated sensors.", heading=SENSE),
    "sensors preview": Entry("Draw the sensor measurements on the way to the best slot.", "sensing:Preview"),
    "fit-sensor-model": Entry("Measure how often slots are seen right.", "sensing:FitSensorModel", SENSE),
    "train-detector": Entry("Train a car model on photographs.", "detect:TrainDetector", SENSE),
    "evaluate-detector": Entry("Measure a detector on labelled images.", "detect:EvaluateDetector", SENSE),
}
app = make_app(
    "Search for a free parking space: worlds, planners, and comparisons between them.",
    """
    parkenv demo --quick                       the whole story, in about two minutes
    parkenv compare --scenario mini -n 20      agents in the same worlds
    parkenv COMMAND --help                     every command has examples
    """,
    COMMANDS,
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"parkenv {__version__}")
        raise typer.Exit


@app.callback()
def _global_options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    del version


MAX_MESSAGE = 1_500  # maximum length of an error message, characters


def main() -> None:
    """Entry point; exit codes: 2 for invalid input, 70 for an error of parkenv's own, 128 + n after signal n."""
    # Both are None where they are closed.
    sys.stdout, sys.stderr = (s or Path(os.devnull).open("w") for s in (sys.stdout, sys.stderr))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names may hold what the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    warnings.formatwarning = lambda message, *_: f"parkenv: warning: {message}\n"
    with stop_signals() as received:
        try:
            _require_unicode(sys.argv[1:])
            code = app(standalone_mode=False, prog_name="parkenv")
        except (Exception, KeyboardInterrupt) as error:
            # Libraries turn an interruption into errors of their own, such as failed imports.
            code = None if received else _report(error)
            if received:
                # What was interrupted could not close its files.
                warnings.simplefilter("ignore", ResourceWarning)
    if received:
        if workers := sys.modules.get("parkenv.studies.workers"):
            workers.kill_workers()
        code = 128 + received[0]
    sys.exit(code if isinstance(code, int) else 0)


def _require_unicode(words: Sequence[str]) -> None:
    for word in words:
        require(
            word == word.encode(errors="replace").decode(), f"{word!a:.200} on the command line is not UTF-8"
        )


def _report(error: BaseException) -> int:
    match error:
        case InputError() | SensorError():
            return _complain(str(error))
        case typer.TyperException():
            pattern = r"Invalid value for '([^']+)'(?: / '[^']+')*: (?:Value error, )?"
            message = re.sub(pattern, r"\1: ", error.format_message()).rstrip(".")
            path = getattr(getattr(error, "ctx", None), "command_path", "parkenv")
            # Without a command, the help has already been printed.
            return _complain(f"{message}; see {path} --help") if message else 2
        case typer.Abort() | KeyboardInterrupt():
            return 130
        case OSError() if error.filename is not None or error.errno in (
            errno.ENOSPC,
            errno.EDQUOT,
            errno.EFBIG,
        ):
            return _complain(": ".join(str(part) for part in (error.filename, error.strerror) if part))
        case ModuleNotFoundError() if extra := _extra_with(error.name or ""):
            return _complain(f"{needs_extra('this', extra)} ({error})")
    return _report_crash(error)


def _extra_with(module: str) -> str | None:
    """Return the smallest extra of the package that installs a module, if there is one."""
    library = module.partition(".")[0].replace("_", "-")
    extras: dict[str, set[str]] = {}
    try:
        lines = requires("parkenv") or ()
    except PackageNotFoundError:  # a source tree that is not installed
        return None
    for line in lines:
        if match := re.fullmatch(r"([\w-]+).*;.*extra == [\"']([\w-]+)[\"'].*", line):
            extras.setdefault(match[2], set()).add(match[1])
    with_it = [extra for extra, libraries in extras.items() if library in libraries]
    return min(with_it, key=lambda extra: len(extras[extra]), default=None)


def _complain(message: str) -> int:
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(message.split()))
    # A value from a file may be pages long.
    line = line if len(line) <= MAX_MESSAGE else f"{line[: MAX_MESSAGE - 200]} ... {line[-200:]}"
    typer.echo(f"parkenv: error: {line}", err=True)
    return 2


def _report_crash(error: BaseException) -> int:
    """Keep the traceback of an unforeseen error in a file, and name it; return the exit code of such errors."""
    text = "".join(traceback.format_exception(error))
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="parkenv-", suffix=".txt", encoding="utf-8", errors="backslashreplace", delete=False
        ) as file:
            file.write(f"{sys.argv}\n{text}")
    except OSError:
        typer.echo(text, err=True)
        return 70
    _complain(f"unforeseen {type(error).__name__}: {error!s:.200}; please report it with {file.name}")
    return 70  # EX_SOFTWARE
