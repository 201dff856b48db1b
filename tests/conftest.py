"""How tests are run: by which process, with how many threads, and with which examples."""

import gc
import os
import sys

import hypothesis
import pytest

# Each core has a test process already. Threads of several that wait for each other by spinning take 20 times as long.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# The same examples on every machine, however slow it is just now; a test's files may serve all of its examples.
hypothesis.settings.register_profile(
    "parkenv",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.function_scoped_fixture],
)
hypothesis.settings.load_profile("parkenv")


def pytest_runtest_setup():
    """Take back the threads, one per core, that numba's first parallel loop gives to torch and scikit-learn.

    They share OpenMP's library, and threads that wait for each other by spinning take the other test process's core.
    """
    if "PYTEST_XDIST_WORKER" in os.environ and "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


def pytest_collection_finish():
    """Let the garbage collector look less often: compiling makes many objects that reference counting frees."""
    gc.set_threshold(20_000, 20, 20)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Files stay together until a process has nothing left to do and takes over half of what waits for another.

    So what a test has compiled or set up serves the others of its file, processes do not begin by compiling the same,
    and none is idle at the end.
    """
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless Chromium for the tests of a module."""
    from chromium import opened

    driver = opened(tmp_path_factory.mktemp("profile"))
    yield driver
    driver.quit()
