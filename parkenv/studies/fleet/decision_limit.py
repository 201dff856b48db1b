"""A time limit for the decisions of an agent in Python."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from parkenv.errors import InputError
from parkenv.studies.interruption import unsafe_to_raise

_RETRY_S = 0.05
"""Time until the signal is sent again if raising an exception was not safe, s."""


class LimitedAgent:
    """An agent whose decisions raise an error after a time.

    The error comes from a timer's signal, which Python handles between two of its instructions. So compiled code that
    never returns is not stopped.

    Args:
        agent: has `predict(observation, state)`.
        limit_s: wall time of a decision, s.

    Raises:
        InputError: this platform, or this thread, gets no signals.
    """

    def __init__(self, agent: Any, limit_s: float) -> None:
        main = threading.current_thread() is threading.main_thread()
        if not hasattr(signal, "setitimer") or not main:
            where = "this thread" if hasattr(signal, "setitimer") else "this operating system"
            raise InputError(f"--decision-limit needs a timer signal, which {where} does not get")
        self._agent, self._limit_s = agent, limit_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self._agent, name)

    def predict(self, observation: Any, state: Any = None) -> tuple[Any, Any]:
        """Return the agent's action and its next state.

        Raises:
            TimeoutError: the agent took longer than its limit.
        """
        with _raising_after(self._limit_s):
            action, state = self._agent.predict(observation, state)
        return action, state


@contextmanager
def _raising_after(limit_s: float) -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        del number
        if unsafe_to_raise(frame):
            signal.setitimer(signal.ITIMER_REAL, _RETRY_S)
            return
        signal.setitimer(signal.ITIMER_REAL, limit_s)  # once more, for an agent that catches the error
        raise TimeoutError(f"no decision within {limit_s:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    try:
        try:
            signal.setitimer(signal.ITIMER_REAL, limit_s)
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    finally:
        # The signal may have come just before the timer was stopped.
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
