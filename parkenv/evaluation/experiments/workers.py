"""Run tasks in this process, in other processes of this machine, or on a Ray or Dask cluster."""

from __future__ import annotations

import functools
import importlib
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self, TypeVar, get_args
from urllib.parse import urlsplit

from joblib import Parallel, delayed

from parkenv.errors import InputError
from parkenv.files.names import BackendName

BACKENDS = get_args(BackendName)
CONNECT_S = 5.0
"""Time for a cluster to answer at its address, s."""
LOSSES = 3
"""Maximum number of workers that may die in a row without finishing a task."""

Result = TypeVar("Result")
Task = Callable[[], Result]


class Workers:
    """Runs independent tasks; the results do not depend on where they run.

    If a worker dies, e.g. because its machine went down, only its current task is lost, and is run again.

    Args:
        jobs: number of processes; 1 with loky runs everything in this process; None uses all cores. Ignored for a
            cluster at an address.
        backend: `loky` for processes of this machine, through joblib; or `ray` or `dask`.
        address: address of a cluster (dask: `tcp://HOST:8786`; ray: `HOST:6379` or `ray://HOST:10001`). Without one,
            ray and dask start a cluster on this machine and stop it at the end.

    Raises:
        InputError: the backend is unknown or not installed, or there is no cluster at the address.

    Examples:
        >>> with Workers(jobs=1) as workers:
        ...     sorted(workers.results([int, float]))
        [(0, 0), (1, 0.0)]
    """

    def __init__(self, jobs: int | None = 1, backend: str = "loky", address: str | None = None) -> None:
        if backend not in BACKENDS:
            raise InputError(f"backend is {backend!r}, want one of {', '.join(BACKENDS)}")
        if address is not None and backend == "loky":
            raise InputError("address goes with the backend ray or dask; loky works on this machine alone")
        if jobs is not None and jobs < 1:
            raise InputError(f"jobs is {jobs}, want at least 1, or None for all cores")
        self.jobs, self.backend, self.address = jobs, backend, address
        self._open = ExitStack()
        self._run: Callable[[dict[int, Task[Any]]], Iterator[tuple[int, Any]]] = self._run_by_loky
        self._lost: type[BaseException] | tuple[type[BaseException], ...] = BrokenProcessPool

    def __enter__(self) -> Self:
        with ExitStack() as opened:
            if self.address is not None:
                _require_listener(self.address)
            if self.backend == "ray":
                self._start_ray(opened)
            elif self.backend == "dask":
                self._start_dask(opened)
            self._open = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    @property
    def in_process(self) -> bool:
        """Whether tasks run in this process."""
        return self.backend == "loky" and (self.jobs or core_count()) == 1

    def results(self, tasks: Sequence[Task[Result]]) -> Iterator[tuple[int, Result]]:
        """Run all tasks; yield index and result of each as it finishes, in any order.

        Raises:
            RuntimeError: workers die repeatedly without finishing a task.
        """
        left = dict(enumerate(tasks))
        losses = 0
        while left:
            try:
                for number, result in self._run(dict(left)):
                    del left[number]
                    losses = 0
                    yield number, result
            except self._lost as error:
                losses += 1
                if losses == LOSSES:
                    raise RuntimeError(
                        f"{LOSSES} times in a row a {self.backend} worker died before anything was finished; "
                        f"{len(left)} tasks are left. Is there memory enough for --jobs {self.jobs or 'all'}?"
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

    def _run_by_loky(self, tasks: dict[int, Task[Result]]) -> Iterator[tuple[int, Result]]:
        parallel = Parallel(
            n_jobs=self.jobs or core_count(),
            return_as="generator_unordered",
            batch_size=1,
            pre_dispatch="2*n_jobs",
        )
        yield from parallel(delayed(_numbered)(i, task) for i, task in tasks.items())

    # joblib's Ray backend returns no result before all tasks are done, and its Dask backend does not say which task
    # failed: a crash would lose finished tasks. So use the queues of Ray and Dask themselves.

    def _start_ray(self, opened: ExitStack) -> None:
        # Ray reads these variables on import. The second one hides accelerators from tasks that request none; this will
        # become Ray's default, and Ray warns if it is not set.
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        ray = _required("ray", "ray")
        local = {"num_cpus": self.jobs or core_count(), "include_dashboard": False}
        try:
            ray.init(
                address=self.address or "local",
                log_to_driver=False,
                logging_level="error",
                **({} if self.address else local),
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(f"--backend ray --address {self.address}: {error}") from error
        opened.callback(ray.shutdown)
        self._run = _run_by_ray
        self._lost = (ray.exceptions.WorkerCrashedError, ray.exceptions.NodeDiedError)

    def _start_dask(self, opened: ExitStack) -> None:
        distributed = _required("distributed", "dask")
        address = self.address
        if address is None:
            cluster = distributed.LocalCluster(
                n_workers=self.jobs or core_count(), threads_per_worker=1, dashboard_address=None
            )
            address = opened.enter_context(cluster).scheduler_address
        try:
            client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        except OSError as error:
            raise InputError(f"--backend dask --address {address}: no scheduler answers ({error})") from error
        opened.enter_context(client)
        self._run = functools.partial(_run_by_dask, client)
        self._lost = distributed.scheduler.KilledWorker


def _run_by_ray(tasks: dict[int, Task[Result]]) -> Iterator[tuple[int, Result]]:
    ray = importlib.import_module("ray")
    remote = ray.remote(num_cpus=1, max_retries=LOSSES)(_numbered)
    ahead = 2 * int(ray.cluster_resources().get("CPU", 1))
    waiting = list(tasks.items())[::-1]
    running: list[Any] = []
    while waiting or running:
        while waiting and len(running) < ahead:
            running.append(remote.remote(*waiting.pop()))
        finished, running = ray.wait(running)
        yield from ray.get(finished)


def _run_by_dask(client: Any, tasks: dict[int, Task[Result]]) -> Iterator[tuple[int, Result]]:
    distributed = importlib.import_module("distributed")
    # Not pure: equal tasks of two comparisons must both run.
    futures = [client.submit(_numbered, i, task, pure=False) for i, task in tasks.items()]
    for future in distributed.as_completed(futures, loop=client.loop):
        yield future.result()
        future.release()


HERE = Workers(1)
"""Runs everything in this process."""


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _numbered(number: int, task: Task[Result]) -> tuple[int, Result]:
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
            f"--address {address}: nobody listens there ({error}); is the cluster's head up, and the port right?"
        ) from error


def _required(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f'--backend {extra} needs the extra {extra}: pip install "parkenv[{extra}]"'
        ) from error
