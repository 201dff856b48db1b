"""How tests are run: by which process, and with which examples."""

import hypothesis
import pytest

# The same examples on every machine, however slow it is just now; a test's files may serve all of its examples.
hypothesis.settings.register_profile(
    "parkenv",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.function_scoped_fixture],
)
hypothesis.settings.load_profile("parkenv")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A file's tests stay together: what one of them has compiled, or set up, serves the others."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)
