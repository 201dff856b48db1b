"""Stopped runs leave no process at work and keep what is finished, to be resumed; a folder has one writer."""

import contextlib
import errno
import json
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import time
import uuid
from functools import partial
from pathlib import Path

import killed_once
import pytest
from command_line import parkenv, refused

from parkenv.errors import InputError
from parkenv.files import atomic_write
from parkenv.files.folder_lock import LOCK, folder_lock
from parkenv.lots import load_lot
from parkenv.mapping.store import MapStore
from parkenv.studies import workers
from parkenv.studies.workers import Workers

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


GONE_S = 30.0
"""Time until no process of a stopped run is left."""


def processes_with(mark):
    """Return the living processes with a variable in their environment."""
    living = []
    for environment in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if mark.encode() in environment.read_bytes():
                living.append(int(environment.parent.name))
    return living


def test_a_stopped_command_leaves_no_process_and_says_how_to_go_on(tmp_path):
    out, mark = tmp_path / "out", f"PARKENV_STOPPED_RUN={uuid.uuid4()}"
    words = "compare --scenario mini --agents mdp,greedy-goal,oracle -n 600 --no-figures --jobs 2 --out"
    command = subprocess.Popen(
        [sys.executable, "-m", "parkenv", *words.split(), out, "--occupancy-levels", "none"], text=True,
        env=os.environ | dict([mark.split("=")]), start_new_session=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    stored, deadline = out / "results.sqlite-wal", time.monotonic() + 60.0
    while not (stored.exists() and stored.stat().st_size > 10_000):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    command.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + GONE_S
    while living := processes_with(mark):
        if time.monotonic() > deadline:
            os.killpg(command.pid, signal.SIGKILL)
            raise AssertionError(f"{living} at work: {command.communicate()}")
        time.sleep(0.05)
    output, errors = command.communicate()
    assert "Traceback" not in errors
    assert command.returncode == 143
    assert f"parkenv run {out} --resume goes on" in " ".join(output.split())
    summary = json.loads((out / "summary.partial.json").read_text())
    kept = (out / "episodes.csv").read_text().splitlines()
    assert (summary["complete"], sum(row["episodes"] for row in summary["rows"])) == (False, len(kept) - 1)


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
        for command in ("compare", "survey"):
            assert f"out: process {holder.pid} on " in refused(command, "--scenario", "mini", "--out", out)
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
        with pytest.raises(InputError) as caught, atomic_write.atomic_write(path) as beside:
            beside.write_text("{}")
    assert str(caught.value) == f"{path}: cannot be written: Read-only file system"
    for name in ("", ".", "/"):
        with pytest.raises(InputError, match="is no name of a file"), atomic_write.atomic_write(name):
            pass


@pytest.mark.parametrize(
    "command",
    [("report", "run"), ("fit-sensor-model", "--scenario", "mini", "-n", "1"), ("compare",), ("plan",)],
    ids=lambda command: command[0],
)
def test_what_cannot_be_written_is_refused_before_the_work(tmp_path, command):
    (tmp_path / "run").mkdir()
    summary = {"command": ["parkenv", "park"], "version": "0.1.0", "rows": [{"lot": "mini"}]}
    (tmp_path / "run" / "summary.json").write_text(json.dumps(summary))
    (tmp_path / "file").touch()
    done = parkenv(*command, "--out", "file/made", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("parkenv: error: --out file")
    assert ": cannot be written (" in done.stderr


@contextlib.contextmanager
def small_files(size):
    """Let this process write files of so many bytes at most."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@small_files(2_000)
def test_a_full_disk_leaves_files_as_they_were_and_makes_none(tmp_path):
    path = tmp_path / "episodes.csv"
    path.write_text("one\n")
    with pytest.raises(InputError, match="written: File too large"), atomic_write.atomic_write(path) as new:
        new.write_text("x" * 3_000)
    assert path.read_text() == "one\n"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(InputError, match=r"m\.sqlite: cannot be written: .* the size of files limited"):
        MapStore(tmp_path / "m.sqlite", load_lot("mini"))
    assert list(tmp_path.iterdir()) == [path]


@small_files(2_000)
def test_files_that_belong_together_are_all_written_or_none(tmp_path):
    (tmp_path / "a").write_text("before")

    def write(size):
        with atomic_write.write_together(tmp_path) as folder:
            for name, length in (("a", 1_000), ("b", size)):
                with atomic_write.atomic_write(folder / name) as beside:
                    beside.write_text("x" * length)

    with pytest.raises(InputError, match=f"^{tmp_path / 'b'}: cannot be written: File too large"):
        write(3_000)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["before"]
    write(500)
    assert {path.name: path.stat().st_size for path in tmp_path.iterdir()} == {"a": 1_000, "b": 500}
