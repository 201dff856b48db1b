"""Benchmark suites with fewer searches, in this process."""

import contextlib
from dataclasses import replace
from unittest import mock

from parkenv.studies.benchmark.suite import Suite

SEARCHES = 150
"""Searches of a task."""


@contextlib.contextmanager
def few_searches():
    """While the block runs, `parkenv benchmark run` makes the first searches of each task only."""
    named = Suite.named

    def shorter(cls, name):
        suite = named(name)
        return replace(suite, seeds=suite.seeds[:SEARCHES])

    with mock.patch.object(Suite, "named", classmethod(shorter)):
        yield
