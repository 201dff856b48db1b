"""What an import guessed, and how doubtful the result is; kept in the lot file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.limited_reading import read_json


@dataclass(frozen=True)
class Doubt:
    """A reason to doubt a lot, and how likely it makes the lot wrong, 0 to 1."""

    reason: str
    chance: float

    def __str__(self) -> str:
        return f"{self.chance:.2f} {self.reason}"


@dataclass(frozen=True)
class Provenance:
    """Where a lot comes from: the file, what was guessed, and the reasons to doubt it."""

    source: str
    guesses: tuple[str, ...] = ()  # one sentence each
    doubts: tuple[Doubt, ...] = ()

    def document(self) -> dict[str, Any]:
        """Return the JSON object that a lot file keeps."""
        return {
            "source": self.source,
            "guesses": list(self.guesses),
            "doubts": [{"reason": doubt.reason, "chance": round(doubt.chance, 3)} for doubt in self.doubts],
        }


def combined(doubts: tuple[Doubt, ...]) -> float:
    """Return the score of doubt, 0 to 1: the chance that a lot is wrong, if its reasons are independent."""
    right = 1.0
    for doubt in doubts:
        right *= 1.0 - min(max(doubt.chance, 0.0), 1.0)
    return 1.0 - right


def read_provenance(path: Path) -> Provenance | None:
    """Return what a lot file says of its import; None if it says nothing.

    Raises:
        InputError: the member `import` is malformed.
    """
    document = read_json(path)
    origin = document.get("import") if isinstance(document, dict) else None
    if origin is None:
        return None
    try:
        guesses, doubts = origin["guesses"], origin["doubts"]
        return Provenance(
            str(origin["source"]),
            tuple(str(guess) for guess in guesses),
            tuple(Doubt(str(doubt["reason"]), float(doubt["chance"])) for doubt in doubts),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: import is {origin!r:.60}, want an object with source, guesses and doubts"
        ) from error
