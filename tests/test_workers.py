"""Tasks give the same results wherever they run, and a dead worker loses its own task only."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from zlib import crc32

import killed_once
import pytest
from lot_checks import refusal
from test_stopped_runs import small_files
from toy_study import Toy

from parkenv import InputError
from parkenv.studies import study as studies
from parkenv.studies.runner import Interrupted, open_run, run
from parkenv.studies.workers import SERIAL, Workers, kill_workers

each_backend = pytest.mark.parametrize(
    "backend", ["loky", *(pytest.param(name, marks=pytest.mark.slow) for name in ("ray", "dask"))]
)
TOY, LONG = Toy(jobs=1), Toy(jobs=1, numbers=40)


@pytest.fixture(autouse=True)
def _importable_by_workers(monkeypatch):
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")])))


def of(backend: str) -> Workers:
    for module in {"ray": ["ray"], "dask": ["dask", "distributed"]}.get(backend, []):
        pytest.importorskip(module, reason=f"the extra {backend} is not installed")
    return Workers(2, backend)


def squares(workers: Workers, count: int) -> dict[int, int]:
    return dict(workers.results([partial(killed_once.square, k) for k in range(count)]))


def test_results_carry_the_number_of_their_task_and_come_in_order_where_asked():
    with Workers(2) as workers:
        assert squares(workers, 20) == {k: k * k for k in range(20)}
        ordered = workers.in_order([partial(killed_once.square, k) for k in range(20)])
        assert list(ordered) == [k * k for k in range(20)]
    assert squares(SERIAL, 5) == {k: k * k for k in range(5)}
    assert list(SERIAL.results([])) == []


@each_backend
@pytest.mark.filterwarnings("ignore")
def test_bad_input_that_a_worker_finds_is_named_as_it_is(backend):
    with of(backend) as workers, pytest.raises(InputError, match=r"^value is 3$"):
        list(workers.results([partial(killed_once.refuse, 3)] * 2))


@each_backend
@pytest.mark.filterwarnings("default")  # the libraries' own, about sockets and workers that died
def test_a_killed_worker_loses_its_own_task_which_is_run_again(tmp_path, backend):
    marker = str(tmp_path / "killed")
    with of(backend) as workers:
        tasks = [partial(killed_once.square_killed_once, marker, k) for k in range(12)]
        told = list(workers.results(tasks))
    assert sorted(told) == [(k, k * k) for k in range(12)], "every task once"
    assert Path(marker).exists()
    assert Path(f"{marker}.3").read_text() == "run\n"
    again = sum(Path(f"{marker}.{k}").read_text().count("run") for k in range(12)) - 12
    # loky breaks up the pool when a worker dies, so that the one beside it starts its task over, too.
    assert again <= (3 if backend == "loky" else 0)


@each_backend
def test_nothing_in_the_working_folder_runs_in_place_of_pythons_own(tmp_path, backend):
    of(backend)
    for name in ("pickle", "socket", "cloudpickle", "queue"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r})")
    code = (
        "from parkenv.studies.workers import Workers\n"
        "if __name__ == '__main__':\n"
        f"    with Workers(2, {backend!r}) as workers:\n"
        "        print(sorted(workers.results([int, float])))"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "[(0, 0), (1, 0.0)]\n", done.stderr
    assert not (tmp_path / "ran").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_without_tasks_are_killed_on_request():
    with Workers(2) as workers:
        started = set(workers.in_order([os.getpid] * 8))
    assert all(Path(f"/proc/{pid}").exists() for pid in started)
    kill_workers()
    assert not any(Path(f"/proc/{pid}").exists() for pid in started)
    kill_workers()
    assert squares(Workers(2), 3) == {0: 0, 1: 1, 2: 4}, "others are started"


def test_workers_print_nothing_into_the_progress_bars_and_dying_again_and_again_end_the_run(capfd):
    with Workers(2) as workers:
        list(workers.results([killed_once.warn] * 2))
    assert capfd.readouterr().err == ""
    with Workers(2) as workers, pytest.raises(RuntimeError, match="3 times in a row a loky worker died"):
        list(workers.results([killed_once.die] * 2))


def wrapped_interruption():
    """As numba's loader of compiled code lets one through."""
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as error:
        raise SystemError("returned a result with an exception set") from error


def other_error():
    raise SystemError("of another kind")


def test_an_interruption_is_one_whatever_it_is_wrapped_in():
    with pytest.raises(KeyboardInterrupt):
        list(SERIAL.results([wrapped_interruption]))
    with pytest.raises(SystemError, match="of another kind"):
        list(SERIAL.results([other_error]))


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ((1, "slurm"), "backend is 'slurm', want one of loky, ray, dask"),
        ((1, "loky", "localhost:1"), "address requires the backend ray or dask"),
        ((0,), "jobs is 0, want at least 1"),
        ((2, "ray", "127.0.0.1:9"), "no cluster answers"),
        ((2, "dask", "tcp://127.0.0.1:9"), "no cluster answers"),
        ((2, "dask", "tcp://somewhere"), "want HOST:PORT"),
        ((2, "ray", "127.0.0.1:notaport"), "want HOST:PORT"),
    ],
)
def test_what_does_not_go_together_or_answer_is_refused_at_once(arguments, wanted):
    start = time.monotonic()
    with pytest.raises(InputError, match=wanted), Workers(*arguments):
        pass
    assert time.monotonic() - start < 15.0


def files_of(folder):
    return {path.name: path.read_text() for path in folder.iterdir() if path.name != "results.sqlite"}


def test_a_study_runs_without_a_folder_and_its_result_holds_the_files():
    result = run(TOY)
    assert result.rows == [{"power": 2, "sum": 55}, {"power": 3, "sum": 225}]
    assert result.complete
    assert result.summary["command"] == ["parkenv", "run", "experiment.json"]
    folder = result.folder
    files = {"powers.csv", "summary.json", "settings.json", "experiment.json", "done.txt"}
    assert files <= files_of(folder).keys()
    del result
    assert not folder.exists()


def test_workers_change_nothing_and_warnings_come_once(tmp_path):
    with pytest.warns(UserWarning, match=r"Power\(power=2\): 4 comes before 4") as warned:
        run(TOY.changed(powers=(2,), warns=True), tmp_path / "one")
    assert len(warned) == 1
    with pytest.warns(UserWarning, match="comes before 4"):
        run(TOY.changed(powers=(2,), warns=True, jobs=2), tmp_path / "two")
    one, two = files_of(tmp_path / "one"), files_of(tmp_path / "two")
    assert one.pop("experiment.json") != two.pop("experiment.json")
    assert one == two


def test_progress_counts_what_is_finished(tmp_path):
    seen = []
    run(TOY, tmp_path, progress=lambda *news: seen.append(news))
    assert seen[0] == ("Searching", 0, 12)
    assert seen[-2:] == [("Drawing figures", 0, 1), ("Drawing figures", 1, 1)]
    more = []
    run(TOY.changed(numbers=7), tmp_path, resume=True, progress=lambda *news: more.append(news))
    assert more[0] == ("Searching", 12, 14)
    assert run(TOY.changed(numbers=7)).rows == open_run_of(tmp_path).rows
    run(TOY.changed(powers=(3,), numbers=7), tmp_path, resume=True)
    kept = (tmp_path / "powers.csv").read_text().split()
    assert [line[0] for line in kept[1:]] == [*"3" * 7, *"2" * 7], "what was there stays, after the rest"


def open_run_of(folder):
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(studies.STUDIES, "toy", "toy_study:Toy")
        return open_run(folder)


def test_a_finished_run_is_read_again(tmp_path):
    result, again = run(TOY, tmp_path), open_run_of(tmp_path)
    assert (again.study, again.rows, again.summary) == (TOY, result.rows, result.summary)
    assert TOY.rows_of(TOY.cells()[1], again.results)[2] == {"power": 3, "number": 2, "value": 8}
    assert "holds no finished run" in refusal(open_run, tmp_path / "none")


def test_a_folder_of_another_run_is_kept_unless_it_is_replaced(tmp_path):
    run(TOY, tmp_path)
    before = files_of(tmp_path)
    for options, message in (
        ({}, "holds a finished toy run; add --resume to go on with it"),
        ({"resume": True}, "offset was 0 in"),
    ):
        with pytest.raises(InputError, match=message):
            run(TOY.changed(offset=1), tmp_path, **options)
        assert files_of(tmp_path) == before
    assert run(TOY.changed(offset=1), tmp_path, overwrite=True).rows[0]["sum"] == 61
    assert "holds no toy run to resume" in refusal(run, TOY, tmp_path / "new", resume=True)
    assert not (tmp_path / "new").exists()


def test_an_interrupted_run_keeps_its_rows_and_is_resumed(tmp_path, monkeypatch):
    def stop_at_five(news, done, total):
        if done == 6:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        run(TOY, tmp_path / "stopped", progress=stop_at_five)
    assert not stopped.value.result.complete
    assert stopped.value.result.rows == [{"power": 2, "sum": 55}, {"power": 3, "sum": 0}]
    partial_summary = json.loads((tmp_path / "stopped" / "summary.partial.json").read_text())
    assert partial_summary["rows"] == stopped.value.result.rows
    assert len(Toy.table.read(tmp_path / "stopped")) == 6
    run(TOY, tmp_path / "stopped", resume=True)
    run(TOY, tmp_path / "whole")
    assert files_of(tmp_path / "stopped") == files_of(tmp_path / "whole")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The files of an unbroken run."""
    folder = tmp_path_factory.mktemp("whole")
    run(LONG, folder)
    return files_of(folder)


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
@pytest.mark.parametrize(("number", "jobs"), [(signal.SIGKILL, 1), (signal.SIGTERM, 2), (signal.SIGINT, 1)])
def test_a_killed_run_keeps_what_is_finished_and_is_resumed_to_the_same_files(tmp_path, whole, number, jobs):
    script = (
        "import signal, sys; from pathlib import Path; from toy_study import Toy\n"
        "from parkenv.cli.stop_signals import stop_signals; from parkenv.studies.runner import run\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background\n"
        "def tell(doing, done, total): print(done, flush=True)\n"
        "toy = Toy(numbers=40, pause_s=0.1, jobs=int(sys.argv[2]))\n"
        "with stop_signals(): run(toy, Path(sys.argv[1]), progress=tell)\n"
    )
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    command = [sys.executable, "-c", script, tmp_path, str(jobs)]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}, text=True, **streams)
    told = next(done for line in process.stdout if (done := int(line)) >= 8)
    process.send_signal(number)
    process.communicate()
    assert told <= len(Toy.table.read(tmp_path)) < 80
    assert (tmp_path / "powers.csv").exists() == (number != signal.SIGKILL)
    run(LONG, tmp_path, resume=True)
    assert files_of(tmp_path) == whole


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_text("this is a letter to my aunt" * 20),
        lambda file: file.write_bytes(file.read_bytes()[:3_000]),
        lambda file: file.write_bytes(file.read_bytes().replace(b'"value": 125', b'"value": 925')),
        lambda file: changed(file, "UPDATE row SET value = '7', crc32 = 3_552_281_999 WHERE name <> 'head'"),
        lambda file: changed(file, "DROP TABLE row"),
        lambda file: changed(file, "PRAGMA user_version = 9"),
        lambda file: file.unlink() or sqlite3.connect(file).executescript("CREATE TABLE row (name)"),
    ],
)
def test_a_store_that_is_no_longer_as_it_was_written_is_named(tmp_path, damage):
    run(TOY, tmp_path)
    damage(tmp_path / "results.sqlite")
    assert "results.sqlite: " in refusal(run, TOY, tmp_path, resume=True)


def changed(file, statement):
    database = sqlite3.connect(file)
    database.executescript(statement.replace("3_552_281_999", str(crc32(b"7"))))
    database.close()


def test_a_full_disk_ends_a_run_with_a_word_and_leaves_what_was_finished(tmp_path):
    wanted = r"results\.sqlite: cannot be written: .* is the disk full"
    with small_files(60_000), pytest.raises(InputError, match=wanted):
        run(LONG, tmp_path)
    assert 0 < len(Toy.table.read(tmp_path)) < 80
    assert run(LONG, tmp_path, resume=True).rows == run(LONG).rows


def test_errors_of_a_task_leave_what_was_finished(tmp_path, monkeypatch):
    power = Toy.run

    def fail(self, work, items):
        if work.power == 3:
            raise InputError("no cubes")
        return power(self, work, items)

    monkeypatch.setattr(Toy, "run", fail)
    assert "no cubes" in refusal(run, TOY, tmp_path)
    assert len(Toy.table.read(tmp_path)) == 6
    monkeypatch.undo()
    assert run(TOY, tmp_path, resume=True).rows[1]["sum"] == 225
