"""Runs in processes of their own that a signal stops at some moment, and what they leave.

As a program, trials at random moments: `python tests/stopped_runs.py compare SIGTERM 10` prints a line for each.
"""

import csv
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path

from command_line import parkenv

from parkenv.studies.training.training import MODEL

COMMANDS = {
    "compare": "compare --scenario mini --agents mdp,greedy-goal,oracle -n 600 --occupancy-levels none --no-figures",
    "survey": "survey --scenario mini --sessions 3 --every 12",
    "train": "train ppo --scenario mini --steps 6000 --trainings 2 --evaluate-every 1500 --evaluation-episodes 4 "
    "--agents none",
}
"""Of all studies, those that keep rows alone, rows and a map, and checkpoints."""
START_S = 1.5
"""Time that a process takes to import its modules."""
GONE_S = 5.0
"""Time until no process of a stopped run is left."""


class Run:
    """A command of `COMMANDS` that runs in processes of its own, as in a terminal."""

    def __init__(self, name, out):
        self.mark = f"PARKENV_STOPPED_RUN={uuid.uuid4()}"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "parkenv", *COMMANDS[name].split(), "--jobs", "2", "--out", out],
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


def finished(name, out, *options):
    """Run a command to its end, in this process; other workers, same result."""
    done = parkenv(*COMMANDS[name].split(), "--jobs", 1, "--out", out, *options)
    assert done.returncode == 0, (done.stdout, done.stderr)


def resume(name, out):
    """Finish a stopped run as its own message says."""
    again = name == "survey" or not (out / "settings.json").exists()
    finished(name, out, *([] if again else ["--resume"]))


def result_of(name, out):
    """Return what does not depend on wall time."""
    rows = json.loads((out / "summary.json").read_text())["rows"]
    if name == "compare":
        return (out / "episodes.csv").read_bytes(), [row["total_s"] for row in rows]
    if name == "survey":
        with (out / "sessions.csv").open(newline="") as file:
            sessions = [{**row, "seconds_per_frame": None} for row in csv.DictReader(file)]
        return sessions, rows[0]["occupancy_mae"]
    # Weights come after the header, whose length is in the first 8 bytes, and which names the command line.
    models = [(out / f"seed_{seed}" / MODEL).read_bytes() for seed in (0, 1)]
    return [m[8 + int.from_bytes(m[:8], "little") :] for m in models], [row["total_s"] for row in rows]


def trial(name, number, moment, folder, unbroken):
    """Stop a run after `moment` seconds and finish it; return what happened, in a line."""
    out = folder / "out"
    run = Run(name, out)
    time.sleep(moment)
    if run.process.poll() is not None:
        run.process.communicate()
        return "over before"
    code, output, errors = run.stop(number)
    ends = {0, -number} if number == signal.SIGKILL else {0, -number, 128 + number}
    assert code in ends, (code, output, errors)
    if number != signal.SIGKILL:
        assert "Traceback" not in errors, errors
        assert not output.strip() or "Interrupted" in output or (out / "summary.json").exists(), output
    kept = any(out.glob("*")) if out.exists() else False
    assert not (out / ".lock").exists() or number == signal.SIGKILL
    if code == 0 or (out / "summary.json").exists():
        return "over before"
    resume(name, out)
    assert not list(out.rglob(".*.part"))
    assert result_of(name, out) == unbroken
    return f"exit {code}, {'something' if kept else 'nothing'} kept, results equal"


def trials(name, number, seeds):
    """Yield the outcome of trials at random moments of a run."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        started = time.monotonic()
        finished(name, whole)
        lasts = START_S + time.monotonic() - started
        for seed in seeds:
            moment = random.Random(f"{name} {number} {seed}").uniform(0.0, lasts)
            with tempfile.TemporaryDirectory() as its:
                outcome = trial(name, number, moment, Path(its), result_of(name, whole))
            yield f"{moment:5.2f} s of {lasts:.1f}", outcome


if __name__ == "__main__":
    command, name_of_signal, count = sys.argv[1:]
    for when, outcome in trials(command, signal.Signals[name_of_signal], range(int(count))):
        sys.stdout.write(f"{command} | {name_of_signal} | {when} | {outcome}\n")
        sys.stdout.flush()
