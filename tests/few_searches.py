"""Benchmark suites with fewer searches, in this process."""

import contextlib
from dataclasses import replace
from unittest import mock

from parkenv.cli import benchmark

SEARCHES = 150
"""Searches of a task."""


@contextlib.contextmanager
def few_searches():
    """While the block runs, `parkenv benchmark run` makes the first searches of each task only."""
    run_suite = benchmark.run_suite

    def run_first(*arguments):
        from parkenv.studies.compare.benchmark import Suite

        named = Suite.named

        def shorter(cls, name):
            suite = named(name)
            return replace(suite, seeds=suite.seeds[:SEARCHES])

        with mock.patch.object(Suite, "named", classmethod(shorter)):
            run_suite(*arguments)

    with mock.patch.object(benchmark, "run_suite", run_first):
        yield
