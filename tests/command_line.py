"""Run the command line for tests: in this process, or in a separate one that can be killed."""

import contextlib
import csv
import io
import json
import subprocess
import sys
import warnings
from unittest import mock

from parkenv.cli import main

PARKENV = [sys.executable, "-c", "from parkenv.__main__ import main; main()"]
"""The command in a separate process."""


def parkenv(words="", *arguments, cwd=None):
    """Run the command in this process, which has everything imported and compiled code loaded.

    `words` are separated by spaces; further arguments may have any in them.

    Returns a `CompletedProcess` with `returncode`, `stdout` and `stderr`, as `subprocess.run` does.
    """
    argv = ["parkenv", *str(words).split(), *map(str, arguments)]
    out, err = io.StringIO(), io.StringIO()

    def show(message, category, filename, lineno, file=None, line=None):
        err.write(warnings.formatwarning(message, category, filename, lineno, line))

    with (
        mock.patch.object(sys, "argv", argv),
        mock.patch.object(warnings, "formatwarning"),
        warnings.catch_warnings(),
        contextlib.chdir(cwd or "."),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        warnings.simplefilter("default")
        warnings.showwarning = show
        try:
            main()
        except SystemExit as end:
            code = end.code
    return subprocess.CompletedProcess(argv, code or 0, out.getvalue(), err.getvalue())


def ran(*arguments, cwd=None):
    """Run a command that ends well."""
    done = parkenv(*arguments, cwd=cwd)
    assert done.returncode == 0, (done.stdout, done.stderr)
    return done


def refused(*arguments, cwd=None):
    """Run a command that is refused in one line, and return this line."""
    done = parkenv(*arguments, cwd=cwd)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), (done.stdout, done.stderr)
    return done.stderr


def summary_of(folder):
    """The summary in the folder of a run."""
    return json.loads((folder / "summary.json").read_text())


def rows_in(file):
    """The rows of a CSV file, as texts by column."""
    with file.open(newline="") as lines:
        return list(csv.DictReader(lines))
