"""Slots inspected in random order: (n + 1)/(m + 1) looks until a free one, if m of n are free.

The m free slots cut the other n - m into m + 1 stretches. In a random order all stretches have the same mean length,
(n - m)/(m + 1), and the first free slot comes right after the first stretch.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.verify.line import THESIS_SPEEDS, Line
from parkenv.studies.verify.rows import Row, Task, mean_row
from planners.agent import make_agent

SOURCE = "order statistics without replacement"
SLOTS = 10
TAKEN = 0.6  # probability that a slot is taken: all numbers of free slots from 2 to 6 are frequent
FREE = (2, 3, 4, 5, 6)
EPISODES = 24_000


def looks(first: int, episodes: int) -> list[tuple[int, int]]:
    """Return for each search how many slots were free, and how many were looked at up to the first free one.

    All slots are equally likely to be free, so given how many are, those are a random subset: slots in the order of the
    lane are slots in random order. `greedy-drive` looks at one after the other.
    """
    scenario = Line(TAKEN, THESIS_SPEEDS, SLOTS - 1, 0).scenario()
    runner = EpisodeRunner(scenario, "greedy-drive", make_agent("greedy-drive", scenario))
    rows = (runner.run(seed).row for seed in range(first, first + episodes))
    return [(round(SLOTS * (1.0 - row["occupancy"])), row["slots_passed"]) for row in rows]


def rows(seed: int) -> list[Row]:
    """Return a row for each number of free slots, all from the same searches."""
    found = np.array(looks(seed, EPISODES))
    return [
        mean_row(
            f"looks, {m} of {SLOTS} slots free: greedy-drive",
            (SLOTS + 1) / (m + 1),
            found[found[:, 0] == m, 1],
            SOURCE,
        )
        for m in FREE
    ]


def tasks(seed: int) -> list[Task]:
    """Return the tasks of this case."""
    return [partial(rows, seed)]
