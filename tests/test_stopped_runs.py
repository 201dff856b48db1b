"""Stopped runs leave no process at work and keep what is finished, to be resumed; a folder has one writer."""

import errno
import json
import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import killed_once
import pytest
from command_line import parkenv
from stopped_runs import Run, finished, result_of

from parkenv.errors import InputError
from parkenv.files import atomic_write
from parkenv.files.atomic_write import append_text
from parkenv.files.folder_lock import LOCK, folder_lock
from parkenv.lots import load_lot
from parkenv.mapping.store import MapStore
from parkenv.studies import runner, workers
from parkenv.studies.results import Results
from parkenv.studies.workers import Workers

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


def has_lines(path, count):
    deadline = time.monotonic() + 60.0
    while not (path.exists() and len(path.read_text().splitlines()) > count):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_stopped_command_leaves_no_process_and_is_resumed_to_the_same_result(tmp_path):
    out = tmp_path / "out"
    command = Run(out)
    has_lines(out / "episodes.csv", 5)
    code, output, errors = command.stop(signal.SIGTERM)
    assert "Traceback" not in errors
    assert code == 143
    assert f"parkenv run {out} --resume goes on" in " ".join(output.split())
    summary = json.loads((out / "summary.partial.json").read_text())
    kept = (out / "episodes.csv").read_text().splitlines()
    assert (summary["complete"], sum(row["episodes"] for row in summary["rows"])) == (False, len(kept) - 1)
    finished(out, "--resume")
    assert set(kept) <= set((out / "episodes.csv").read_text().splitlines())
    finished(tmp_path / "whole")
    assert result_of(out) == result_of(tmp_path / "whole")


def test_ctrl_c_while_modules_are_imported_is_quiet(tmp_path):
    """On a fast machine the command has begun its work at the last moment, and says where that is."""
    outputs = []
    for moment in (0.05, 0.6):
        run = Run(tmp_path / "out")
        run.wait_for_entry()
        time.sleep(moment)
        code, output, errors = run.stop(signal.SIGINT)
        assert (code in (-signal.SIGINT, 130), errors) == (True, "")
        assert output == "" or output.startswith(("Searching", "Interrupted."))
        outputs.append(output)
    assert "" in outputs, "none was stopped during imports"


SIGNALLED = """
import os, signal, subprocess, sys, time
from parkenv.cli.stop_signals import stop_signals
{before}
try:
    with stop_signals():
        {within}
        while True:
            pass
except KeyboardInterrupt:
    print('stopped')
"""
MOMENTS = {
    "compiled code runs": (
        "import collections, numba, numpy as np\n"
        "Made = collections.namedtuple('Made', 'sum n')\n"
        "@numba.njit\n"
        "def work(n):\n"
        "    made = np.zeros(1)\n"
        "    for i in range(n):\n"
        "        made[0] += np.sin(i)\n"
        "    return Made(made[0], n)\n"
        "work(1)",
        "subprocess.Popen(['sh', '-c', f'sleep 0.1; kill -TERM {os.getpid()}'])\n        while True: work(1_000_000)",
    ),
    # Modules in C++ end the process if an exception passes through their code.
    "a compiled module is imported": (
        "from importlib.machinery import ExtensionFileLoader\n"
        "def of_compiled(frame):\n"
        "    return frame and (frame.f_code is ExtensionFileLoader.exec_module.__code__ or of_compiled(frame.f_back))\n"
        "class Finder:\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if of_compiled(sys._getframe()):\n"
        "            sys.meta_path.remove(self)\n"
        "            os.kill(os.getpid(), signal.SIGTERM)\n"
        "sys.meta_path.insert(0, Finder())",
        "import scipy.linalg",
    ),
    # And leave the file open, which is told as a ResourceWarning.
    "the file of a module is opened": (
        "import _io\n"
        "open_code = _io.open_code\n"
        "def interrupted(path):\n"
        "    _io.open_code = open_code\n"
        "    file = open_code(path)\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    return file",
        "_io.open_code = interrupted; import colorsys",
    ),
    # LLVM calls Python for each module that it has compiled, and an exception there would be printed and ignored.
    "numba compiles": (
        "import numba\n"
        "from llvmlite.binding.executionengine import ExecutionEngine\n"
        "find = ExecutionEngine._find_module_ptr\n"
        "def interrupted(*arguments):\n"
        "    ExecutionEngine._find_module_ptr = find\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    return find(*arguments)",
        "ExecutionEngine._find_module_ptr = interrupted; numba.njit(lambda x: x + 1)(1); time.sleep(30)",
    ),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_signal_stops_whatever_is_at_work_and_leaves_nothing_open(moment):
    before, within = MOMENTS[moment]
    script = SIGNALLED.replace("{before}", before).replace("{within}", within)
    command = [sys.executable, "-W", "default::ResourceWarning", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "stopped\n"), done.stderr
    assert moment == "compiled code runs" or done.stderr == ""


@pytest.mark.parametrize("thread", ["main", "other"])
def test_workers_end_with_their_killed_parent(tmp_path, thread):
    """Linux kills them; the workers of a thread that may end before the process watch for themselves."""
    script = (
        "import sys, threading, killed_once\n"
        "from functools import partial\n"
        "from parkenv.studies.workers import Workers\n"
        "def work():\n"
        f"    list(Workers(2).results([partial(killed_once.wait, {str(tmp_path)!r})] * 2))\n"
        "other = threading.Thread(target=work)\n"
        f"{'work()' if thread == 'main' else 'other.start(); other.join()'}\n"
    )
    here = str(Path(__file__).parent)
    path = os.pathsep.join([here, *sys.path])
    parent = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": path})
    while len(started := list(tmp_path.iterdir())) < 2:
        assert parent.poll() is None
        time.sleep(0.02)
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 3.0
    while any(Path("/proc", worker.name).exists() for worker in started):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_there_are_no_more_workers_than_cores_and_tasks(monkeypatch):
    monkeypatch.setattr(workers, "cpu_count", lambda: 3)
    assert Workers(1000).jobs == Workers(None).jobs == 3
    before = set(multiprocessing.active_children())
    with Workers(1000) as many:
        list(many.results([partial(killed_once.square, k) for k in range(2)]))
    assert len(set(multiprocessing.active_children()) - before) <= 2


def test_a_folder_has_one_writer(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    torn = out / ".episodes.csv.123.part"
    torn.touch()
    holder = subprocess.Popen(
        [
            sys.executable, "-c", "import sys, time; from pathlib import Path; from parkenv.files import folder_lock\n"
            "with folder_lock.folder_lock(Path(sys.argv[1])): print(flush=True); time.sleep(60)", out,
        ],
        stdout=subprocess.PIPE,
    )  # fmt: skip
    try:
        holder.stdout.readline()
        assert not torn.exists()
        for command in ("compare", "fleet", "survey", "train", "calibrate", "demo", "park"):
            refused = parkenv(command, "--scenario", "mini", "--out", out)
            assert refused.returncode == 2
            assert f"out: process {holder.pid} on " in refused.stderr
            assert len(refused.stderr.splitlines()) == 1
        assert [path.name for path in out.iterdir()] == [LOCK]
    finally:
        holder.kill()
        holder.communicate()
    with folder_lock(out), pytest.raises(InputError, match=f"process {os.getpid()} on"), folder_lock(out):
        pass
    assert not list(out.iterdir())


def test_a_file_system_that_is_read_only_is_named(tmp_path, monkeypatch):
    def refuse(self, *_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    path = tmp_path / "a.json"
    with monkeypatch.context() as patched:
        for action in ("write_text", "unlink"):
            patched.setattr(Path, action, refuse)
        with pytest.raises(InputError) as refused, atomic_write.atomic_write(path) as beside:
            beside.write_text("{}")
    assert str(refused.value) == f"{path}: cannot be written: Read-only file system"


@pytest.mark.parametrize("name", ["", ".", "/"])
def test_what_is_no_name_of_a_file_is_refused(name):
    with (
        pytest.raises(InputError, match="cannot be written: is no name of a file"),
        atomic_write.atomic_write(name),
    ):
        pass


@pytest.mark.parametrize(
    "command",
    [("report", "run"), ("fit-sensor-model", "--scenario", "mini", "-n", "1"), ("compare",), ("plan",)],
    ids=lambda command: command[0],
)
def test_what_cannot_be_written_is_refused_before_the_work(tmp_path, command):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "summary.json").write_text(
        json.dumps({"command": ["parkenv", "park"], "version": "0.1.0", "rows": [{"lot": "mini"}]})
    )
    (tmp_path / "file").touch()
    refused = parkenv(*command, "--out", "file/made", cwd=tmp_path)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.startswith("parkenv: error: --out file")
    assert ": cannot be written (" in refused.stderr
    assert refused.stderr.count("\n") == 1


def test_a_full_disk_leaves_files_as_they_were(tmp_path):
    path = tmp_path / "episodes.csv"
    path.write_text("one\n")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (6, limits[1]))
    try:
        with pytest.raises(InputError, match=r"episodes\.csv: cannot be written: File too large"):
            append_text(path, "two\n")
        with pytest.raises(InputError, match="cannot be written"), atomic_write.atomic_write(path) as beside:
            beside.write_text("another text\n")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_text() == "one\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.fixture
def small_files():
    """Lets this process write files of 2,000 bytes at most."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_map_that_cannot_be_written_leaves_no_file(tmp_path, small_files):
    with pytest.raises(InputError, match=r"m\.sqlite: cannot be written: .* the size of files limited"):
        MapStore(tmp_path / "m.sqlite", load_lot("mini"))
    assert list(tmp_path.iterdir()) == []


def test_files_that_belong_together_are_all_written_or_none(tmp_path, small_files):
    (tmp_path / "a").write_text("before")

    def write(size):
        with atomic_write.write_together(tmp_path) as folder:
            for name, length in (("a", 1_000), ("b", size)):
                with atomic_write.atomic_write(folder / name) as beside:
                    beside.write_text("x" * length)

    with pytest.raises(
        InputError, match=f"^{re.escape(str(tmp_path / 'b'))}: cannot be written: File too large"
    ):
        write(3_000)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["before"]
    write(500)
    assert {path.name: path.stat().st_size for path in tmp_path.iterdir()} == {"a": 1_000, "b": 500}


def test_a_run_that_cannot_be_resumed_promises_nothing(tmp_path, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Results, "begin", stop)
    done = parkenv("compare", "--scenario", "mini", "--agents", "first-free", "--jobs", 1, "--out", tmp_path)
    assert (done.returncode, done.stdout) == (130, "Interrupted.\n")
    assert parkenv("run", tmp_path, "--resume").returncode == 2


def test_a_comparison_on_a_full_disk_ends_in_a_line_and_is_resumed(tmp_path, monkeypatch):
    out, whole = tmp_path / "out", tmp_path / "whole"
    arguments = ("compare", "--scenario", "mini", "--agents", "first-free,oracle", "-n", 60, "--occupancy-levels",
                 "none", "--no-figures", "--jobs", 1, "--out")  # fmt: skip
    calls = iter(range(100))

    def full(descriptor):
        if next(calls) == 5:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(atomic_write.os, "fsync", full)
        patched.setattr(runner, "SYNC_S", 0.0)
        done = parkenv(*arguments, out)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert f"{out / 'episodes.csv'}: cannot be written: No space left on device" in done.stderr
    kept = (out / "episodes.csv").read_text()
    assert len(kept.splitlines()) > 1
    assert parkenv(*arguments, out, "--resume").returncode == 0
    assert parkenv(*arguments, whole).returncode == 0
    assert (out / "episodes.csv").read_bytes() == (whole / "episodes.csv").read_bytes()
    assert (whole / "episodes.csv").read_text().startswith(kept)
