"""Memory for the beliefs of a batch: what its caller still holds stays as it is, and the rest is written again.

A step changes the belief in a few slots only, so copying the beliefs of all searches would take a third of its time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from weakref import ReferenceType, ref

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, IntArray
from parkenv.engine.searches import Searches

_NEVER = -1
_MOST_KEPT = 3  # callers rarely hold on to more than the last two


class _Beliefs:
    """Memory of arrays of `Searches`, by name: what callers got of it, and the last step that wrote to it."""

    def __init__(self, like: Mapping[str, NDArray[np.float32]]) -> None:
        # No array of numpy's: a view would refer to it instead of the array that the caller got.
        self._memory = {name: bytearray(array.nbytes) for name, array in like.items()}
        self.arrays = {name: self._view(name, array.shape) for name, array in like.items()}
        for name, array in like.items():
            self.arrays[name][...] = array
        self.handed_out: list[ReferenceType[NDArray[Any]]] = []
        self.step = _NEVER

    def _view(self, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        return np.ndarray(shape, np.float32, self._memory[name])

    def are_free(self) -> bool:
        """Return whether callers hold nothing, no view of what they got either."""
        return all(array() is None for array in self.handed_out)

    def hand_out(self, name: str) -> NDArray[np.float32]:
        """Return an array, (n, ...), for a caller."""
        handed = self._view(name, (len(self.arrays[name]), self.arrays[name][0].size))
        self.handed_out.append(ref(handed))
        return handed


class BeliefMemory:
    """The memory of `p_occupied` and `belief` of some searches, which keep the full belief."""

    def __init__(self, searches: Searches) -> None:
        self._searches = searches
        self._now = _Beliefs({"p_occupied": searches.p_occupied, "belief": searches.belief})
        searches.hold(**self._now.arrays)
        self._kept = [self._now]
        self._begun_in: IntArray = np.zeros(len(searches.records), np.int64)  # the step
        self._step = 0

    def begin(self, which: BoolArray) -> None:
        """Note that these searches, (n,) bool, begin in this step."""
        np.copyto(self._begun_in, self._step, where=which)

    def renew(self) -> bool:
        """Swap buffers so that arrays returned to callers stay unchanged.

        Returns whether the next step has other memory, where it is to write the belief in all slots that are known.
        """
        self._now.step = self._step
        self._step += 1
        if self._now.are_free():
            self._now.handed_out = []
            return False
        last, self._now = self._now, self._free()
        self._searches.hold(**self._now.arrays)
        begun = np.flatnonzero(self._begun_in > self._now.step)
        for name, array in self._now.arrays.items():
            array[begun] = last.arrays[name][begun]
        return True

    def forget(self) -> None:
        """Note that the beliefs were changed otherwise than by steps."""
        self._kept = [self._now]

    def hand_out(self, name: str) -> NDArray[Any]:
        """Return the array of this name, (n, ...), which nobody changes while it, or a part of it, is held."""
        return self._now.hand_out(name)

    def _free(self) -> _Beliefs:
        """Return beliefs of which callers hold nothing, new ones if they hold all."""
        for beliefs in self._kept:
            if beliefs.are_free():
                beliefs.handed_out = []
                return beliefs
        new = _Beliefs(self._now.arrays)
        self._kept = [*self._kept[1 - _MOST_KEPT :], new]
        return new
