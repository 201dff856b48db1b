"""A world of a user's own: slots that are taken and free by a fixed timetable, in Python alone."""

import numpy as np

from parkenv.world.occupancy.process import Forecast, OccupancyModel, World


class Timetable(OccupancyModel, World):
    """Slot i is taken for `taken_s` of every `period_s`, i * `offset_s` later than slot 0."""

    def __init__(self, lot, goal=0, period_s=1200.0, taken_s=900.0, offset_s=97.0):
        self._n, self._period_s, self._taken_s, self._offset_s = lot.n_slots, period_s, taken_s, offset_s

    @property
    def n_slots(self):
        return self._n

    def forecast(self, arrival):
        return Forecast(np.full(self.n_slots, self._taken_s / self._period_s), np.full(self.n_slots, 1e-3))

    def world(self, key, arrival):
        return self  # the same one at all times

    def occupied(self, slots, time):
        return (time - self._offset_s * np.asarray(slots)) % self._period_s < self._taken_s

    def next_free(self, slots, time):
        since = (time - self._offset_s * np.asarray(slots)) % self._period_s
        return time + np.maximum(self._taken_s - since, 0.0)

    def sojourn(self, slots, time):
        periods = (time - self._offset_s * np.asarray(slots)) // self._period_s
        return (2 * periods + self.occupied(slots, time)).astype(np.int64)
