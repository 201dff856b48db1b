"""Closed forms of the literature: what theory expects, and how to find what this package does.

A form is a function of a module beside this one. It returns its statements, and its docstring is the derivation, in
Markdown. `test_closed_forms.py` checks every statement; the documentation's page of closed forms is made from them.
"""

import importlib
import inspect
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import stats

MODULES = ("line", "queues", "balance", "game", "towns")
CONFIDENCE = 0.9999
"""Confidence of the interval that decides: at 95 %, two of forty right statements would fail by chance."""
ROUNDING = 1e-9
"""Relative difference that rounding may make, where nothing is drawn at random."""


class Statement(NamedTuple):
    case: str  # what is compared, with its parameters
    expected: float  # what theory says
    # Runs planners or worlds: a number, or independent samples with the expected mean.
    found: Callable[[], object]
    tolerance: float = 0.0  # difference that is allowed besides
    slow: bool = False  # takes more than a few seconds

    def interval(self):
        """Return the interval, with Student's t at the level `CONFIDENCE`, in which `expected` has to lie."""
        values = np.atleast_1d(np.asarray(self.found(), dtype=np.float64))
        mean, half = values.mean(), max(self.tolerance, ROUNDING * abs(self.expected))
        if len(values) > 1:
            error = values.std(ddof=1) / np.sqrt(len(values))
            half += stats.t.ppf(0.5 + CONFIDENCE / 2.0, len(values) - 1) * error
        return mean - half, mean + half

    def agrees(self):
        low, high = self.interval()
        return bool(low <= self.expected <= high)


class ClosedForm(NamedTuple):
    title: str
    source: str
    derivation: str
    statements: Callable[[], list[Statement]]


FORMS = list[ClosedForm]()


def closed_form(title, source):
    def add(statements):
        FORMS.append(ClosedForm(title, source, inspect.getdoc(statements), statements))
        return statements

    return add


def all_forms():
    for name in MODULES:
        importlib.import_module(name)
    return sorted(FORMS, key=lambda form: MODULES.index(form.statements.__module__))


def sections():
    return "\n".join(map(section, all_forms()))


def section(form):
    rows = (
        f"| {each.case} | {each.expected:.5g} | {f'± {each.tolerance:g}' if each.tolerance else ''} |"
        for each in form.statements()
    )
    table = "\n".join(["| case | theory | allowed besides |", "|---|---|---|", *rows])
    return f"## {form.title}\n\n*{form.source}.* {form.derivation}\n\n{table}\n"
