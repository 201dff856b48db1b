"""The command line; `parkenv COMMAND --help` explains each command."""

from __future__ import annotations

import errno
import io
import sys
import tempfile
import traceback
import warnings

import typer

from parkenv.cli import (
    bench,
    benchmark,
    calibrate,
    compare,
    demo,
    detect,
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
)
from parkenv.errors import InputError
from sim_sensors.errors import SensorError

app = typer.Typer(
    name="parkenv",
    help="Search for a free parking space: worlds, planners, and comparisons between them.",
    epilog="Start with: parkenv demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("compare")(compare.compare)
app.command("run")(run.run)
app.command("schema")(schema.schema)
app.command("plan")(plan.plan)
app.command("park")(park.park)
app.command("trip")(calibrate.trip)
app.command("calibrate")(calibrate.calibrate)
app.add_typer(lot.app, name="lot")
app.add_typer(occupancy.app, name="occupancy")
app.add_typer(sensors.app, name="sensors")
app.command("demo")(demo.demo)
app.command("survey")(survey.survey)
app.command("map")(survey.show_map)
app.command("fit-sensor-model")(sensor_model.fit_sensor_model)
app.command("detect")(detect.detect)
app.command("train-detector")(detect.train_detector)
app.command("evaluate-detector")(detect.evaluate_detector)
app.command("train")(train.train)
app.command("publish")(publish.publish)
app.command("report")(report.report)
app.command("bench")(bench.bench)
app.add_typer(benchmark.app, name="benchmark")


def _show_version(wanted: bool) -> None:
    if wanted:
        from parkenv import __version__

        typer.echo(f"parkenv {__version__}")
        raise typer.Exit


@app.callback()
def _global_options(
    version: bool = typer.Option(
        False, "--version", help="Print the version.", callback=_show_version, is_eager=True
    ),
) -> None:
    del version


def main() -> None:
    """Entry point; invalid input gives one line on standard error and exit code 2, an error of parkenv's own 70."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names may hold what the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    warnings.formatwarning = lambda message, *_: f"parkenv: warning: {message}\n"
    try:
        code = app(standalone_mode=False)
    except (InputError, SensorError) as error:
        sys.exit(_complain(str(error)))
    except typer.TyperException as error:
        message = error.format_message().rstrip(".")
        # Without a command, the help has already been printed.
        sys.exit(_complain(f"{message}. See parkenv --help, and --help of each command") if message else 2)
    except typer.Abort:
        sys.exit(130)
    except OSError as error:
        if error.filename is None and error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            sys.exit(_report_crash(error))
        sys.exit(_complain(": ".join(str(part) for part in (error.filename, error.strerror) if part)))
    except Exception as error:
        sys.exit(_report_crash(error))
    sys.exit(code if isinstance(code, int) else 0)


def _complain(message: str) -> int:
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(message.split()))
    typer.echo(f"parkenv: error: {line}", err=True)
    return 2


def _report_crash(error: Exception) -> int:
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
