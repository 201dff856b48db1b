"""Compiled code is kept, is never stale, is announced once, and is not counted as work."""

import importlib
import logging
import os
import pickle
import pkgutil
import subprocess
import sys
import tempfile
import typing
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

import parkenv
import planners
import sim_sensors
from parkenv.compiled import code_files, source_key
from parkenv.compiled.clock import seconds_spent
from parkenv.compiled.code_files import cache_folder, compiling_now
from parkenv.compiled.jit import compiled

ROOT = Path(__file__).parents[1]
COMPILES, CANNOT_KEEP = "compiling functions for this machine", "compiled functions cannot be kept in"
OWN = {
    "callee.py": (
        "from parkenv.compiled.jit import compiled\n@compiled\ndef f(x):\n"
        "    if x < 0.0:\n        raise ValueError('x is below 0')\n    return x + 1.0\n"
    ),
    "package/__init__.py": "from .rates import RATE\n",
    "package/rates.py": "RATE = 2.0\n",
    "caller.py": (
        "from callee import f\nfrom package import \\\n    RATE\nfrom parkenv.compiled.jit import compiled\n"
        "@compiled(fastmath={'nnan', 'ninf', 'nsz', 'arcp', 'contract'})\ndef g(x):\n    return RATE * f(x)\n"
    ),
}
"""A user's own modules: g(1.0) is 4."""

PROGRAM = """
from numba.core import event
from caller import g
with event.install_recorder("numba:compile") as compiled:
    print(g(1.0))
print(sum(of.is_start for _, of in compiled.buffer))
"""


@pytest.fixture
def own(tmp_path):
    """The modules, with times of long ago, in a folder of their own."""
    for name, text in OWN.items():
        write(tmp_path / "own" / name, text)
    return tmp_path / "own"


def write(path, text):
    """Write a file whose time never changes, as installers do that keep the times of an archive."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    os.utime(path, (1e9, 1e9))


def start(own, cache, program=PROGRAM, **environment):
    """A new process; by default it prints g(1.0), and how many functions it has compiled."""
    variables = {
        **os.environ, "PYTHONPATH": os.pathsep.join([str(own), str(ROOT)]), "PYTHONDONTWRITEBYTECODE": "1",
        "NUMBA_CACHE_DIR": str(cache), **environment,
    }  # fmt: skip
    return subprocess.Popen(
        [sys.executable, "-c", program], env=variables, cwd=own.parent, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def ended(process):
    """What it printed, and its lines on standard error."""
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    return *map(float, output.split()), errors.splitlines()


def result(process):
    """The value that it printed, and its lines on standard error."""
    value, *_, told = ended(process)
    return value, told


def kept(folder):
    return {path: path.stat().st_mtime_ns for path in Path(folder).rglob("*.nbc")}


@pytest.mark.slow
def test_code_that_two_processes_have_compiled_works_together(own, tmp_path):
    """Numba's `sort` and `argsort` have functions of the same name, and each is the same one of its process."""
    for name, body in (("lowest", "x.sort(); return x[0]"), ("first", "return x.argsort()[0]")):
        text = f"from parkenv.compiled.jit import compiled\n@compiled\ndef {name}(x):\n    {body}\n"
        write(own / f"{name}.py", text)
        prints = f"import numpy as np\nfrom {name} import {name}\nprint({name}(np.array([3.0, 1.0, 2.0])))\n"
        assert result(start(own, tmp_path / "cache", prints))[0] == 1.0
    both = "import numpy as np\nfrom lowest import lowest\nfrom first import first\nx = np.array([3.0, 4.0, 2.0])\n"
    assert ended(start(own, tmp_path / "cache", f"{both}print(first(x), lowest(x))"))[:2] == (2.0, 2.0)


def test_a_caller_is_compiled_again_when_what_it_calls_or_reads_changes(own, tmp_path):
    cache = tmp_path / "cache"
    value, told = result(start(own, cache))
    assert (value, len(told)) == (4.0, 1)
    assert COMPILES in told[0]
    assert str(cache) in told[0]
    first = kept(cache)
    assert len(first) == 2
    assert result(start(own, cache)) == (4.0, []), "nothing is compiled, and nothing said"
    assert kept(cache) == first

    # Of the same length, and with the same time.
    write(own / "callee.py", OWN["callee.py"].replace("1.0", "2.0"))
    assert result(start(own, cache))[0] == 6.0
    write(own / "package/rates.py", "RATE = 3.0\n")
    assert result(start(own, cache))[0] == 9.0
    for name, text in OWN.items():
        write(own / name, text)
    assert result(start(own, cache)) == (4.0, []), "what was compiled from these sources is still there"
    assert not kept(own), "nothing is written beside the sources, which may be read-only"


def test_what_keeps_code_from_being_kept_or_compiled_is_told_in_a_line(own, tmp_path):
    (tmp_path / "file").write_text("")
    value, told = result(start(own, tmp_path / "file" / "cache"))
    assert value == 4.0
    assert [CANNOT_KEEP in line for line in told] == [False, True]
    assert "NUMBA_CACHE_DIR" in told[1]
    process = start(own, tmp_path / "cache", NUMBA_DISABLE_JIT="1")
    assert "NUMBA_DISABLE_JIT is set, want it unset" in process.communicate()[1].splitlines()[-1]
    assert process.returncode == 1


@pytest.mark.slow
def test_of_processes_that_need_the_same_code_one_compiles_it(own, tmp_path):
    cache = tmp_path / "cache"
    together = [ended(process) for process in [start(own, cache) for _ in range(3)]]
    assert [value for value, *_ in together] == [4.0] * 3
    assert sum(compiled for _, compiled, _ in together) == 2
    assert ended(start(own, cache)) == (4.0, 0, [])
    assert all(path.suffix == ".nbc" for path in cache.rglob("*") if path.is_file())


@pytest.mark.parametrize("raises", [False, True])
def test_without_a_home_code_is_kept_in_a_temporary_folder(monkeypatch, tmp_path, raises):
    """No HOME, and no entry of the user in the system's table: versions of platformdirs differ in what they do."""

    def no_home(*_, **__):
        if raises:
            raise RuntimeError("could not determine the home directory")
        return Path("~/.cache/parkenv")

    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(code_files, "user_cache_path", no_home)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert code_files.cache_folder() == tmp_path / f"parkenv-{os.getuid()}" / "compiled"


def test_code_is_kept_in_the_users_folder_unless_another_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert (cache_folder().name, cache_folder().parent.name) == ("compiled", "parkenv")
    assert sys.platform != "linux" or cache_folder().is_relative_to(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "mine"))
    assert cache_folder() == tmp_path / "mine"


@pytest.fixture
def caller(own, tmp_path, monkeypatch):
    """The user's module in this process, with an empty cache."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(own)
    yield importlib.import_module("caller")
    for name in ("caller", "callee", "package", "package.rates"):
        del sys.modules[name]


def test_seconds_of_compiling_and_loading_are_counted_and_no_others(caller, monkeypatch, caplog):
    code_files._announce.cache_clear()
    before = seconds_spent()
    with caplog.at_level(logging.WARNING, logger="parkenv"):
        caller.g(1.0)
        compiling = seconds_spent() - before
        caller.g(1.0)
        assert seconds_spent() - before == compiling > 0.0
        caller.g(1)  # other types are other code
    assert seconds_spent() - before > compiling
    assert sum(COMPILES in message for message in caplog.messages) == 1, "one line in a process"

    again, before = importlib.reload(caller), seconds_spent()
    again.g(1.0)
    assert 0.0 < seconds_spent() - before < compiling, "loading is counted, and takes less"


def test_a_function_can_be_called_by_compiled_code_and_by_python_and_both_get_its_errors(caller):
    for _ in ("compiled", "loaded"):
        assert (caller.g(1.0), caller.f(1.0)) == (4.0, 2.0)
        for function in (caller.g, caller.f):
            with pytest.raises(ValueError, match="x is below 0"):
                function(-1.0)
        del sys.modules["callee"]
        importlib.reload(caller)


def test_damaged_files_are_compiled_again(caller, tmp_path):
    """One with a wrong byte, and one of which a full disk has left less than was written."""
    assert caller.g(1.0) == 4.0
    first, second = tmp_path.rglob("*.nbc")
    content = bytearray(first.read_bytes())
    content[len(content) // 2] ^= 0xFF
    first.write_bytes(content)
    second.write_bytes(second.read_bytes()[:100])
    del sys.modules["callee"]
    assert importlib.reload(caller).g(1.0) == 4.0


class Planted:
    """An object that leaves a mark when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no owners and modes of POSIX")
@pytest.mark.parametrize("mode", [0o644, 0o666, 0o664, "link"])
def test_code_that_others_can_have_written_is_not_read(caller, tmp_path, mode, caplog):
    code_files._warn_of_unsafe_cache.cache_clear()
    assert caller.g(1.0) == 4.0
    for number, file in enumerate(tmp_path.rglob("*.nbc")):
        assert file.stat().st_mode & 0o777 == 0o644
        data = pickle.dumps(Planted(tmp_path / f"ran{number}"))
        file.write_bytes(code_files._digest(file, data) + data)
        if mode == "link":
            file.symlink_to(file.rename(tmp_path / f"theirs{number}"))
        else:
            file.chmod(mode)
    del sys.modules["callee"]
    with caplog.at_level(logging.WARNING, logger="parkenv"):
        assert importlib.reload(caller).g(1.0) == 4.0
    is_safe = mode == 0o644
    assert bool(list(tmp_path.glob("ran*"))) == is_safe, "what this user alone can write is read"
    assert ("others can write" in caplog.text) == (mode in (0o666, 0o664))


def test_a_module_that_is_edited_and_imported_again_runs_its_new_code(caller, own):
    assert caller.g(1.0) == 4.0
    (own / "caller.py").write_text(OWN["caller.py"].replace("RATE * f(x)", "RATE * f(x) + 0.5"))
    importlib.invalidate_caches()
    assert importlib.reload(caller).g(1.0) == 4.5


def test_functions_of_one_name_and_line_are_told_apart_by_their_options(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    halves = [compiled(error_model=model)(one_over) for model in ("python", "numpy")]
    with pytest.raises(ZeroDivisionError):
        halves[0](0.0)
    assert halves[1](0.0) == float("inf")


def one_over(x):
    return 1.0 / x


def compiled_functions():
    for package in (sim_sensors, parkenv, planners):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            for function in vars(importlib.import_module(found.name)).values():
                if isinstance(function, Dispatcher) and function.__module__ == found.name:
                    yield function


def test_every_compiled_function_is_kept_under_a_key_of_all_functions_that_it_calls():
    """Else an edit of the callee would go unnoticed."""
    checked = 0
    for function in compiled_functions():
        sources = source_key._closure(Path(function.py_func.__code__.co_filename).resolve())
        for name in function.py_func.__code__.co_names:
            called = function.py_func.__globals__.get(name)
            if isinstance(called, Dispatcher):
                assert Path(called.py_func.__code__.co_filename).resolve() in sources, (function, name)
                checked += 1
    assert checked > 50


def test_no_compiled_function_gives_python_a_named_tuple():
    """Numba calls Python to make one; an exception of a signal handler ends the process there with a segfault."""
    for function in compiled_functions():
        returned = typing.get_type_hints(function.py_func).get("return")
        for kind in (returned, *typing.get_args(returned)):
            assert function.__name__.startswith("_") or not hasattr(kind, "_fields"), function


def test_what_is_compiled_now_is_seen_from_outside(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = tmp_path / "parkenv.engine.kernel-0123456789abcdef"
    folder.mkdir()
    for name in ("killed-0000.lock", "_observe-0001.lock", "arrive-0002.nbc", "enter-0003.nbc"):
        (folder / name).touch()
    os.utime(folder / "killed-0000.lock", (1.0, 1.0))
    names, n_finished = compiling_now(since_s=2.0)
    assert (names, n_finished) == (["observe"], 2)
