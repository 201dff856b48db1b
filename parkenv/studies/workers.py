"""Run tasks in this process, in other processes of this machine, or on a Ray or Dask cluster."""

import functools
import importlib
import logging
import multiprocessing.resource_tracker
import os
import signal
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar, get_args
from urllib.parse import urlsplit

from joblib import Parallel, cpu_count, delayed
from joblib.externals.loky import process_executor, reusable_executor
from joblib.externals.loky.backend import resource_tracker

from parkenv.errors import InputError, require, require_one_of, with_extra
from parkenv.files.known_names import BackendName

BACKENDS = get_args(BackendName)
CONNECT_S = 5.0  # time for a cluster to answer at its address, s
LOSSES = 3  # maximum number of workers that may die in a row without finishing a task

Result = TypeVar("Result")
Task = Callable[[], Result]


class Workers:
    """Runs independent tasks; the results do not depend on where they run.

    If a worker dies, e.g. because its machine went down, only its current task is lost, and is run again. Workers of
    this machine end with this process, and when the block ends by an exception.

    Args:
        jobs: number of processes, at most one per core and per task; None uses all cores. A single loky process is
            this one. Ignored for a cluster at an address.
        backend: `loky` for processes of this machine, through joblib; or `ray` or `dask`.
        address: address of a cluster (dask: `tcp://HOST:8786`; ray: `HOST:6379` or `ray://HOST:10001`). Without one,
            ray and dask start a cluster on this machine and stop it at the end.

    Examples:
        >>> with Workers(jobs=1) as workers:
        ...     sorted(workers.results([int, float]))
        [(0, 0), (1, 0.0)]
    """

    def __init__(self, jobs: int | None = 1, backend: str = "loky", address: str | None = None) -> None:
        require_one_of("backend", backend, BACKENDS)
        require(
            address is None or backend != "loky",
            "address requires the backend ray or dask; loky works on this machine alone",
        )
        require(jobs is None or jobs >= 1, f"jobs is {jobs}, want at least 1, or None for all cores")
        self.jobs, self.backend, self.address = min(jobs or cpu_count(), cpu_count()), backend, address
        self._open = ExitStack()
        self._run: Callable[[dict[int, Task[Any]]], Generator[tuple[int, Any]]] = self._run_by_loky
        self._results: Generator[tuple[int, Any]] | None = None
        self._lost: type[BaseException] | tuple[type[BaseException], ...] = BrokenProcessPool

    def __enter__(self) -> Self:
        with ExitStack() as opened:
            opened.enter_context(_safe_path())
            if self.address is not None:
                _require_listener(self.address)
            if self.backend != "loky":
                with _interrupts_blocked():
                    (self._start_ray if self.backend == "ray" else self._start_dask)(opened)
            self._open = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._results is not None:
            with warnings.catch_warnings():
                # joblib tells how many results are lost.
                warnings.simplefilter("ignore")
                self._results.close()
        self._open.close()

    @property
    def in_process(self) -> bool:
        return self.backend == "loky" and self.jobs == 1

    def results(self, tasks: Sequence[Task[Result]]) -> Iterator[tuple[int, Result]]:
        """Run all tasks; yield index and result of each as it finishes, in any order.

        Raises:
            RuntimeError: workers die repeatedly without finishing a task.
        """
        self._results = self._run_all(tasks)
        return self._results

    def _run_all(self, tasks: Sequence[Task[Result]]) -> Generator[tuple[int, Result]]:
        left = dict(enumerate(tasks))
        losses = 0
        while left:
            try:
                with closing(self._run(dict(left))) as run:
                    for number, result in run:
                        del left[number]
                        losses = 0
                        yield number, result
            except self._lost as error:
                losses += 1
                if losses == LOSSES:
                    raise RuntimeError(
                        f"{LOSSES} times in a row a {self.backend} worker died before anything was finished; "
                        f"{len(left)} tasks are left. Is there memory enough for --jobs {self.jobs}?"
                    ) from error

    def in_order(self, tasks: Sequence[Task[Result]]) -> Iterator[Result]:
        """Run all tasks; yield their results in the order of the tasks, each as soon as all previous ones are done."""
        ready: dict[int, Result] = {}
        due = 0
        for number, result in self.results(tasks):
            ready[number] = result
            while due in ready:
                yield ready.pop(due)
                due += 1

    def _run_by_loky(self, tasks: dict[int, Task[Result]]) -> Generator[tuple[int, Result]]:
        jobs = min(self.jobs, len(tasks))
        if jobs == 1:
            yield from (_numbered(i, task) for i, task in tasks.items())
            return
        parallel = Parallel(
            n_jobs=jobs,
            return_as="generator_unordered",
            batch_size=1,
            pre_dispatch="2*n_jobs",
            **worker_start(),
        )
        folder = Path.cwd()  # workers of an earlier run may have started in another one
        with _interrupts_blocked():
            results = parallel(delayed(_numbered)(i, task, folder) for i, task in tasks.items())
        with closing(results):
            yield from results

    # Of joblib's own backends (1.6), Ray's returns no result before all tasks are done, and Dask's does not say which
    # task failed: a crash would lose finished tasks. So use the queues of Ray and Dask themselves.

    def _start_ray(self, opened: ExitStack) -> None:
        # Ray reads these variables on import. The second one hides accelerators from tasks that request none; this will
        # become Ray's default, and Ray warns if it is not set.
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        ray = _required("ray", "ray")
        on_sigterm = signal.getsignal(signal.SIGTERM)
        local = {"num_cpus": self.jobs, "include_dashboard": False}
        try:
            ray.init(
                address=self.address or "local",
                log_to_driver=False,
                logging_level="error",
                **({} if self.address else local | {"job_config": _without_working_folder()}),
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(f"--backend ray --address {self.address}: {error}") from error
        if signal.getsignal(signal.SIGTERM) is not on_sigterm:
            signal.signal(signal.SIGTERM, on_sigterm)  # Ray would end this process
        opened.callback(ray.shutdown)
        self._run = _run_by_ray
        self._lost = (ray.exceptions.WorkerCrashedError, ray.exceptions.NodeDiedError)

    def _start_dask(self, opened: ExitStack) -> None:
        distributed = _required("distributed", "dask")
        address = self.address
        if address is None:
            cluster = distributed.LocalCluster(
                n_workers=self.jobs, threads_per_worker=1, dashboard_address=None
            )
            address = opened.enter_context(cluster).scheduler_address
        try:
            client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        except OSError as error:
            raise InputError(f"--backend dask --address {address}: no scheduler answers ({error})") from error
        opened.enter_context(client)
        self._run = functools.partial(_run_by_dask, client)
        self._lost = distributed.scheduler.KilledWorker


def _without_working_folder() -> Any:
    """Return settings for a Ray cluster of this machine, whose workers would look in the working folder first."""
    settings = importlib.import_module("ray.job_config").JobConfig()
    settings._client_job = True  # as Ray's own client does, which transfers folders otherwise
    return settings


def _run_by_ray(tasks: dict[int, Task[Result]]) -> Generator[tuple[int, Result]]:
    ray = importlib.import_module("ray")
    remote = ray.remote(num_cpus=1, max_retries=LOSSES)(_numbered)
    ahead = 2 * int(ray.cluster_resources().get("CPU", 1))
    waiting = list(tasks.items())[::-1]
    running: list[Any] = []
    while waiting or running:
        while waiting and len(running) < ahead:
            running.append(remote.remote(*waiting.pop()))
        finished, running = ray.wait(running)
        try:
            results = ray.get(finished)
        except ray.exceptions.RayTaskError as error:
            # Its text is a traceback.
            if isinstance(error.cause, InputError):
                raise error.cause from error
            raise
        yield from results


def _run_by_dask(client: Any, tasks: dict[int, Task[Result]]) -> Generator[tuple[int, Result]]:
    distributed = importlib.import_module("distributed")
    # Not pure: equal tasks of two comparisons must both run.
    futures = [client.submit(_numbered, i, task, pure=False) for i, task in tasks.items()]
    for future in distributed.as_completed(futures, loop=client.loop):
        yield future.result()
        future.release()


SERIAL = Workers(1)  # runs everything in this process


def worker_start() -> dict[str, Any]:
    """Return `initializer` and `initargs` of a pool whose processes end with this one, even if it is killed."""
    return {"initializer": _start_worker, "initargs": (os.getpid(),)}


def kill_workers() -> None:
    """Kill the workers of this machine that wait for further tasks; at its end this process waits until each has ended.

    Workers that tidy up after themselves take seconds on a busy machine.
    """
    if reusable_executor._executor is not None:
        reusable_executor._executor.shutdown(kill_workers=True)


def _start_worker(parent: int) -> None:
    # loky takes compiled code for a memory leak, and would replace the worker.
    process_executor._MAX_MEMORY_LEAK_SIZE = sys.maxsize
    # The parent says itself that functions are compiled; lines of its workers would break its progress bars.
    logging.getLogger("parkenv").setLevel(logging.ERROR)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


@contextmanager
def _safe_path() -> Iterator[None]:
    """Keep processes that start in the block from taking modules of the working folder in place of Python's own.

    Workers get this process's path once they run, with the folders of users' classes.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT during the block: processes and threads that start there never get it, this thread gets it later.

    Ctrl-C in a terminal goes to all processes; this one stops its workers.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # These processes unblock the signal when they start.
    multiprocessing.resource_tracker.ensure_running()
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _numbered(number: int, task: Task[Result], folder: Path | None = None) -> tuple[int, Result]:
    if folder is not None:
        os.chdir(folder)
    try:
        return number, task()
    except SystemError as error:
        # Ctrl-C while numba unpacks compiled code arrives wrapped in a SystemError.
        inner: BaseException | None = error
        while inner is not None:
            if isinstance(inner, KeyboardInterrupt):
                raise inner from None
            inner = inner.__cause__
        raise


def _require_listener(address: str) -> None:
    """Raise an error if no cluster answers at an address: the libraries themselves would retry for over a minute."""
    parts = urlsplit(address if "://" in address else f"//{address}")
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or port is None:
        raise InputError(f"--address is {address!r}, want HOST:PORT, with tcp:// before it for dask")
    try:
        socket.create_connection((host, port), timeout=CONNECT_S).close()
    except OSError as error:
        raise InputError(
            f"--address {address}: no cluster answers ({error}); is the cluster's head up, and the port right?"
        ) from error


def _required(module: str, extra: str) -> Any:
    with with_extra(f"--backend {extra}", extra):
        return importlib.import_module(module)
