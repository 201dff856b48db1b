"""Tasks give the same results wherever they run, and a dead worker loses its own task only."""

import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import killed_once
import pytest

from parkenv.errors import InputError
from parkenv.studies.workers import SERIAL, Workers, kill_workers

each_backend = pytest.mark.parametrize(
    "backend", ["loky", *(pytest.param(name, marks=pytest.mark.slow) for name in ("ray", "dask"))]
)


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


def test_workers_print_no_lines_into_the_progress_bars_of_their_parent(capfd):
    with Workers(2) as workers:
        list(workers.results([killed_once.warn] * 2))
    assert capfd.readouterr().err == ""


def test_workers_that_die_again_and_again_end_the_run_with_a_word():
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
