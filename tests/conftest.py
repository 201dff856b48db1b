"""How tests are dealt out to processes."""

import pytest


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A file's tests stay together: what one of them has compiled, or set up, serves the others."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)
