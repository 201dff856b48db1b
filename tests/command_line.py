"""Run the command line for tests: in this process, or in a separate one that can be killed."""

import contextlib
import io
import subprocess
import sys
import warnings
from unittest import mock

from parkenv.cli import main

PARKENV = [sys.executable, "-c", "from parkenv.__main__ import main; main()"]
"""The command in a separate process."""


def parkenv(words, *arguments, cwd=None):
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
