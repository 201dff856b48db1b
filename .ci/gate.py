"""The gate: all that a change has to pass, in a fresh environment.

The README's own commands, lint, types, slow tests, documentation, the built package, and the oldest allowed versions of
the dependencies. Stages that do not need each other run side by side, one more than there are cores for, so
that none is idle while a stage waits or has one test left. A stage's output is printed when it ends, and a table of all
stages' seconds at the end. The first failure stops the gate.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CORES = os.cpu_count() or 1
README_COMMAND = re.search(r"<!-- tests -->\n```bash\n(.*?)\n```", (ROOT / "README.md").read_text(), re.S)[1]
INSTALL, _, TESTS = README_COMMAND.rpartition(" && ")


@dataclass(frozen=True)
class Stage:
    """A command, and what it has to wait for.

    Args:
        name: as it stands in the table.
        command: for bash, run from the root of the repository; `$SCRATCH` is an empty folder for all stages.
        needs: names of stages that have to end first.
        cores: how many cores it keeps busy; 0 where it waits for network and disk most of the time.
    """

    name: str
    command: str
    needs: tuple[str, ...] = ()
    cores: int = 1


# In the order in which they start, as soon as what they need is done and there are cores for them.
STAGES = (
    # Reports and documentation are looked at in a real browser.
    Stage(
        "browser",
        "(apt-get update -qq && apt-get install -y -qq chromium chromium-driver) > /dev/null",
        cores=0,
    ),
    Stage("README: install", INSTALL),
    # Not all installers find the small build of torch that pip is configured for.
    Stage(
        "oldest versions: install",
        """
        for name in uv oldest; do python3 -m venv "$SCRATCH/$name"; done
        "$SCRATCH/uv/bin/pip" install --quiet uv
        "$SCRATCH/oldest/bin/pip" install --quiet "torch==2.13.0"
        "$SCRATCH/uv/bin/uv" pip install --quiet --python "$SCRATCH/oldest/bin/python" --resolution lowest-direct \\
            -e ".[dev]" "torch==2.13.0"
        """,
        cores=0,
    ),
    Stage("ruff", ".venv/bin/ruff check . && .venv/bin/ruff format --check .", needs=("README: install",)),
    Stage("README: tests", TESTS, needs=("README: install", "browser", "ruff"), cores=CORES),
    Stage("slow tests", ".venv/bin/pytest -n auto -m slow tests", needs=("README: tests",), cores=CORES),
    Stage("mypy", ".venv/bin/mypy", needs=("README: tests",)),
    Stage(
        "documentation",
        'NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict --quiet --site-dir "$SCRATCH/site"',
        needs=("README: tests",),
    ),
    # The wheel is built from the source distribution, so that it says of both what they hold; it has no extras and is
    # used away from the repository.
    Stage(
        "package, README: demo",
        """
        .venv/bin/python -m build --installer uv --outdir "$SCRATCH/built" . > /dev/null
        uv="$PWD/.venv/bin/uv"
        "$uv" venv --quiet "$SCRATCH/package"
        cd "$SCRATCH"
        "$uv" pip install --quiet --python package/bin/python built/*.whl
        package/bin/parkenv demo --quick --out results/demo
        ls built results/demo
        """,
        needs=("README: tests",),
        cores=CORES,
    ),
    # They warn of what newer ones have mended. Every module is imported; then what each library is used for, in tests
    # that compile little: their version of numba has everything to compile again. Of two processes each begins with one
    # half of the tests, so what compiles the same stands together.
    Stage(
        "oldest versions: tests",
        """
        oldest=("$SCRATCH/oldest/bin/pytest" -p no:cacheprovider -W ignore::DeprecationWarning)
        "${oldest[@]}" --collect-only -qq
        "${oldest[@]}" -n auto \\
            "tests/test_training.py::test_a_stopped_training_goes_on_from_its_checkpoint[maskable-ppo]" \\
            "tests/test_search_env.py::test_every_id_passes_the_checker_without_a_warning[mini-parkenv/Search-v2]" \\
            tests/test_compare.py::test_figures_and_occupancy_levels \\
            tests/test_{compilation,lot_files,hog,lot}.py \\
            --deselect tests/test_lot_files.py::test_commands_state_parking_costs_and_draw_them \\
            tests/test_survey.py::test_survey_and_map_on_the_command_line \\
            tests/test_{mapping,figures,drive_env}.py
        """,
        needs=("oldest versions: install", "README: tests"),
        cores=CORES,
    ),
)


@dataclass
class Run:
    """A stage under way or ended, and its log."""

    stage: Stage
    scratch: Path
    started: float = field(default_factory=time.monotonic)
    seconds: float = 0.0

    def __post_init__(self) -> None:
        self.log = self.scratch / f"{self.stage.name.replace(': ', '-').replace(' ', '_')}.log"
        environment = {
            **os.environ,
            "SCRATCH": str(self.scratch),
            "PYTHONWARNINGS": "default",
            "NUMBA_CACHE_DIR": str(self.scratch / "compiled"),
            # Stages share the cores; torch's threads would wait for each other by spinning.
            "OMP_NUM_THREADS": "1",
            # Of thousands of modules few are ever imported, and translated then.
            "PIP_COMPILE": "no",
        }
        # Hundreds of processes would each translate all modules anew.
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                ["bash", "-euo", "pipefail", "-c", self.stage.command],
                cwd=ROOT,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def ended(self) -> bool:
        """Whether the command has ended; keeps the seconds that it took."""
        if self.process.poll() is None:
            return False
        self.seconds = time.monotonic() - self.started
        self.stop()
        return True

    def stop(self) -> None:
        """End the command and everything that it has started."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def show(self, outcome: str) -> None:
        """Print the log."""
        print(f"\n=== {self.stage.name}: {outcome}, {time.monotonic() - self.started:.0f} s", flush=True)
        sys.stdout.buffer.write(self.log.read_bytes())
        sys.stdout.buffer.flush()


def run_all(stages: list[Stage], scratch: Path) -> list[Run]:
    """Run the stages; return those that have ended, in that order. The last one may have failed."""
    waiting, running, ended = list(stages), [], []
    known = {stage.name for stage in stages}
    try:
        while waiting or running:
            done = {run.stage.name for run in ended}
            for stage in list(waiting):
                busy = sum(run.stage.cores for run in running)
                if set(stage.needs) & known <= done and busy <= CORES:
                    print(f"--- {stage.name} begins", flush=True)
                    waiting.remove(stage)
                    running.append(Run(stage, scratch))
            for run in [run for run in running if run.ended()]:
                running.remove(run)
                ended.append(run)
                if run.process.returncode != 0:
                    run.show(f"FAILED with exit code {run.process.returncode}")
                    return ended
                run.show("passed")
            time.sleep(0.2)
    finally:
        for run in running:
            run.stop()
            run.show("stopped")
    return ended


def main() -> int:
    """Run the gate; return its exit code."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    stages = list(STAGES)
    if shutil.which("chromium") and shutil.which("chromedriver"):
        stages = [stage for stage in stages if stage.name != "browser"]
    shutil.rmtree(ROOT / ".venv", ignore_errors=True)
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="gate-", ignore_cleanup_errors=True) as scratch:
        ended = run_all(stages, Path(scratch))
    print("\n=== seconds of each stage (stages run side by side)")
    for run in ended:
        began = run.started - begun
        print(f"{run.stage.name:26} {run.seconds:6.0f}   from {began:5.0f} to {began + run.seconds:5.0f}")
    print(f"{'in all':26} {time.monotonic() - begun:6.0f}")
    failed = [run.stage.name for run in ended if run.process.returncode != 0]
    if failed:
        print(f"FAILED: {failed[0]}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
