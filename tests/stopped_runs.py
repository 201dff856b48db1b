"""A run in processes of its own that a signal stops at some moment, and what it leaves."""

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

from command_line import parkenv

COMMAND = (
    "compare --scenario mini --agents mdp,greedy-goal,oracle -n 600 --occupancy-levels none --no-figures"
)
GONE_S = 5.0
"""Time until no process of a stopped run is left."""


class Run:
    """`COMMAND`, which runs in processes of its own, as in a terminal."""

    def __init__(self, out):
        self.mark = f"PARKENV_STOPPED_RUN={uuid.uuid4()}"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "parkenv", *COMMAND.split(), "--jobs", "2", "--out", out],
            env=os.environ | dict([self.mark.split("=")]),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            # A shell's background jobs, and what they start, ignore Ctrl-C.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )

    def wait_for_entry(self):
        """Wait until the entry point runs, or the process has ended: until then, Ctrl-C ends Python with a traceback.

        Python catches SIGINT from its start. The entry point, after the import of the package and thus of NumPy, gives
        it back to the system; the command then catches it with SIGTERM.
        """
        of_process, deadline = Path(f"/proc/{self.process.pid}"), time.monotonic() + 60.0
        while self.process.poll() is None:
            caught = int(of_process.joinpath("status").read_text().partition("SigCgt:")[2].split()[0], 16)
            by_python, by_command = (caught >> (n - 1) & 1 for n in (signal.SIGINT, signal.SIGTERM))
            if (by_command or not by_python) and "/numpy/" in of_process.joinpath("maps").read_text():
                return
            assert time.monotonic() < deadline
            time.sleep(0.002)

    def stop(self, number):
        """Send a signal; Ctrl-C goes to all processes of the terminal. Return exit code, output, errors."""
        if number == signal.SIGINT:
            self.wait_for_entry()
        (os.killpg if number == signal.SIGINT else os.kill)(self.process.pid, number)
        sent = time.monotonic()
        while living := self.processes():
            if time.monotonic() > sent + GONE_S:
                for pid in living:
                    os.kill(pid, signal.SIGKILL)
                raise AssertionError(
                    f"{living} at work {GONE_S} s after {number!r}: {self.process.communicate()}"
                )
            time.sleep(0.05)
        output, errors = self.process.communicate()
        return self.process.returncode, output, errors

    def processes(self):
        """Return the living processes that this run has started."""
        living = []
        for environment in Path("/proc").glob("[0-9]*/environ"):
            try:
                if self.mark.encode() in environment.read_bytes():
                    living.append(int(environment.parent.name))
            except OSError:
                pass
        return living


def finished(out, *options):
    """Run the command to its end, in this process; other workers, same result."""
    done = parkenv(f"{COMMAND} --jobs 1 --out", out, *options)
    assert done.returncode == 0, (done.stdout, done.stderr)


def result_of(out):
    """Return what does not depend on wall time."""
    rows = json.loads((out / "summary.json").read_text())["rows"]
    return (out / "episodes.csv").read_bytes(), [row["total_s"] for row in rows]
