"""The command line; `parkenv COMMAND --help` explains each command."""

from __future__ import annotations

import errno
import io
import os
import re
import sys
import tempfile
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from parkenv import __version__
from parkenv.cli import (
    bench,
    benchmark,
    calibrate,
    commute,
    compare,
    demo,
    detect,
    fleet,
    lot,
    occupancy,
    park,
    plan,
    publish,
    report,
    run,
    schema,
    sensor_model,
    sensors,
    survey,
    train,
    verify,
)
from parkenv.cli.command import add, group
from parkenv.cli.stop_signals import stop_signals
from parkenv.errors import InputError
from sim_sensors.errors import SensorError

app = group(
    "parkenv",
    """Search for a free parking space: worlds, planners, and comparisons between them.

    Examples:
      parkenv demo --quick                       the whole story on a small lot
      parkenv compare --scenario mini -n 20      agents in the same worlds
      parkenv COMMAND --help                     every command has examples
    """,
)
START, SEARCH, SENSE, DRIVE, DATA = (
    "Start here", "Search and compare", "Sensors and maps", "Drive", "Lots, logs and files",
)  # fmt: skip
add(app, "demo", demo.demo, START)
add(app, "compare", compare.compare, SEARCH)
add(app, "report", report.report, SEARCH)
add(app, "commute", commute.commute, SEARCH)
add(app, "fleet", fleet.fleet, SEARCH)
add(app, "plan", plan.plan, SEARCH)
add(app, "train", train.train, SEARCH)
add(app, "publish", publish.publish, SEARCH)
add(app, "run", run.run, SEARCH)
app.add_typer(benchmark.app, rich_help_panel=SEARCH)
add(app, "survey", survey.survey, SENSE)
add(app, "map", survey.show_map, SENSE)
add(app, "map-drive", survey.map_drive, SENSE)
app.add_typer(sensors.app, rich_help_panel=SENSE)
add(app, "fit-sensor-model", sensor_model.fit_sensor_model, SENSE)
add(app, "detect", detect.detect, SENSE)
add(app, "train-detector", detect.train_detector, SENSE)
add(app, "evaluate-detector", detect.evaluate_detector, SENSE)
add(app, "trip", calibrate.trip, DRIVE)
add(app, "calibrate", calibrate.calibrate, DRIVE)
add(app, "park", park.park, DRIVE)
app.add_typer(lot.app, rich_help_panel=DATA)
app.add_typer(occupancy.app, rich_help_panel=DATA)
add(app, "schema", schema.schema, DATA)
add(app, "verify", verify.verify, DATA)
add(app, "bench", bench.bench, DATA)


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


MAX_MESSAGE = 1_500
"""Maximum length of an error message, characters."""


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
    """Refuse names of files in other encodings: results are JSON, and could not name them."""
    for word in words:
        if word != word.encode(errors="replace").decode():
            raise InputError(f"{word!a:.200} on the command line is not UTF-8")


def _report(error: BaseException) -> int:
    """Print an error in a line; return the exit code."""
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
    return _report_crash(error)


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
