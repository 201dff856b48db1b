"""An agent in a process of its own, such as a planner of a library whose requirements clash with parkenv's.

    PIPED="examples.peers.in_another_environment:Piped(command=CLASHES/bin/python examples/peers/pomdp_planners.py)"
    parkenv compare --scenario mini --agents "belief,$PIPED"

The process reads lines of JSON and writes one answer to each; `examples/peers/pomdp_planners.py` is one. The first line
is `{"problem": {...}}`, what an agent may know: the lot as GeoJSON, costs and speeds, and the drive graph with what
each move costs, for those who do without parkenv. Its answer is `{"ready": true}`. Each further line is an observation
of `parkenv/Search-v2`, `{"search": 3, "observation": {"vertex": 12, ...}}`, where `search` counts searches; the answer
is `{"action": 0}` to 4. Nothing is unpickled. What the process writes to its error stream is in messages of errors.
"""

from __future__ import annotations

import json
import queue
import shlex
import subprocess
import tempfile
import threading
import weakref
from contextlib import suppress
from itertools import count, pairwise
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from parkenv.belief.slot_belief import SlotBelief
from parkenv.errors import InputError, require_number
from parkenv.lots.formats.geojson import write_lot
from parkenv.world.lot import ACTIONS
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent

LONGEST_LINE = 100_000  # characters of an answer
_SCALARS = (
    "goal", "v_drive", "v_walk", "failure_s", "wait_s", "give_up_s", "stay_s", "value_of_time", "priced_at_s", "kwh",
    "walk_back",
)  # fmt: skip


class Piped(SearchAgent[int]):
    """Asks a process for every action.

    Args:
        problem: the problem.
        command: the command line, without a shell; quotes group words.
        timeout_s: time for an answer, s.
        start_s: time for the answer to the problem and for the first action, which may have to compile, s.
        seed: sent with the problem, for planners that draw random numbers.
    """

    name: ClassVar[str] = "piped"

    def __init__(
        self,
        problem: SearchProblem,
        command: str,
        timeout_s: float = 60.0,
        start_s: float = 300.0,
        seed: int = 0,
    ) -> None:
        super().__init__(problem)
        self.words = shlex.split(command.strip("'\""))
        if not self.words:
            raise InputError("command is empty, want a command line")
        require_number("timeout_s", timeout_s, above=0.0)
        require_number("start_s", start_s, above=0.0)
        self.timeout_s, self.start_s, self.seed = timeout_s, start_s, seed
        self.searches, self.process = count(), None

    def __getstate__(self) -> dict[str, Any]:
        """Copies in other workers start processes of their own."""
        return vars(self) | {"process": None}

    def begin(self, observation: Observation, belief: SlotBelief) -> int:
        """Return the number of the search."""
        del observation, belief
        return next(self.searches)

    def decide(self, observation: Observation, belief: SlotBelief, memory: int) -> int:
        """Ask for an action."""
        del belief
        if self.process is None:
            self.process, self.limit_s = _Process(self.words), self.start_s
            answer = self.process.ask({"problem": described(self.problem), "seed": self.seed}, self.start_s)
            if answer.get("ready") is not True:
                raise InputError(
                    f'{self.words[0]}: answered {answer!s:.80} to the problem, want {{"ready": true}}'
                )
        plain = {name: np.asarray(values).tolist() for name, values in observation.items()}
        action = self.process.ask({"search": memory, "observation": plain}, self.limit_s).get("action")
        self.limit_s = self.timeout_s
        if not isinstance(action, int) or isinstance(action, bool) or not 0 <= action < len(ACTIONS):
            raise InputError(f"{self.words[0]}: action is {action!r:.40}, want 0 to {len(ACTIONS) - 1}")
        return action


class _Process:
    """The process behind the pipe; it ends with this object, or with parkenv."""

    def __init__(self, words: list[str]) -> None:
        self.name, self.errors = words[0], tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        try:
            process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.errors, encoding="utf-8"
            )
        except OSError as error:
            raise InputError(f"command {self.name!r:.60} cannot be run: {error.strerror}") from None
        self.process, self.lines = process, queue.SimpleQueue[str]()
        threading.Thread(target=_read, args=(process.stdout, self.lines), daemon=True).start()
        weakref.finalize(self, _end, process, self.errors)

    def ask(self, message: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        """Send a message, and return the answer."""
        try:
            self.process.stdin.write(json.dumps(message) + "\n")
            self.process.stdin.flush()
            line = self.lines.get(timeout=timeout_s)
        except BrokenPipeError:
            line = ""
        except queue.Empty:
            self.process.kill()
            raise InputError(f"{self.name}: no answer within {timeout_s:g} s{self._last_words()}") from None
        if not line:
            code = self.process.wait()
            raise InputError(f"{self.name}: ended with exit code {code}{self._last_words()}")
        try:
            answer = json.loads(line)
        except ValueError:
            answer = None
        if not isinstance(answer, dict) or not line.endswith("\n"):
            raise InputError(f"{self.name}: answered {line!r:.80}, want a line with a JSON object")
        return answer

    def _last_words(self) -> str:
        self.errors.seek(0)
        lines = self.errors.read().decode("utf-8", "replace").strip().splitlines()
        return f"; its last line: {lines[-1]:.200}" if lines else ""


def _read(stream: IO[str], lines: queue.SimpleQueue[str]) -> None:
    with stream:
        while line := stream.readline(LONGEST_LINE):
            lines.put(line)
    lines.put("")


def _end(process: subprocess.Popen[str], errors: IO[bytes]) -> None:
    process.kill()
    process.wait()
    errors.close()
    with suppress(OSError):  # what it has not read
        process.stdin.close()


def described(problem: SearchProblem) -> dict[str, Any]:
    """Return a problem as JSON; infinite arrival costs, of slots where one may not park, are null."""
    if problem.tariff or problem.classes or problem.sensor_model.bands:
        raise InputError(
            "a process has no word for tariffs of the scenario, classes of users or bands of a sensor model"
        )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "lot.geojson"
        write_lot(problem.lot, file)
        lot = json.loads(file.read_text(encoding="utf-8"))
    starts, slots = problem.slots_in_view
    sensor = problem.sensor_model
    return {
        "lot": lot,
        "fields": {name: getattr(problem, name) for name in _SCALARS},
        "sensor": {name: getattr(sensor, name) for name in ("view_range", "hit_rate", "false_alarm_rate")},
        "graph": {
            "n_slots": problem.lot.n_slots,
            "neighbors": problem.lot.neighbors.tolist(),  # (n_vertices, 4), -1 for none
            "move_s": problem.move_s.tolist(),  # (n_vertices, 4)
            "arrival_cost_s": [
                cost if np.isfinite(cost) else None for cost in problem.arrival_cost_s.tolist()
            ],
            "in_view": [slots[a:b].tolist() for a, b in pairwise(starts)],
        },
    }
