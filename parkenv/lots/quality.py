"""What an import guessed, and how likely the result is wrong; kept in the lot file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.limited_reading import read_json


@dataclass(frozen=True)
class QualityIssue:
    """A reason why a lot may differ from the place."""

    reason: str
    error_probability: float  # that it makes the lot wrong, 0 to 1

    def __str__(self) -> str:
        return f"{self.error_probability:.2f} {self.reason}"


@dataclass(frozen=True)
class Provenance:
    """Where a lot comes from: the file, what was guessed, and what may be wrong with it."""

    source: str
    guesses: tuple[str, ...] = ()  # one sentence each
    issues: tuple[QualityIssue, ...] = ()
    caution: str = ""  # what decides results and is a guess

    def document(self) -> dict[str, Any]:
        """Return the JSON object that a lot file keeps."""
        return {
            "source": self.source,
            "guesses": list(self.guesses),
            "issues": [
                {"reason": issue.reason, "error_probability": round(issue.error_probability, 3)}
                for issue in self.issues
            ],
            **({"caution": self.caution} if self.caution else {}),
        }


def combined_error_probability(issues: tuple[QualityIssue, ...]) -> float:
    """Return the probability, 0 to 1, that a lot is wrong, if its issues are independent."""
    right = 1.0
    for issue in issues:
        right *= 1.0 - min(max(issue.error_probability, 0.0), 1.0)
    return 1.0 - right


def read_provenance(path: Path) -> Provenance | None:
    """Return what a lot file says of its import; None if it says nothing."""
    document = read_json(path)
    origin = document.get("import") if isinstance(document, dict) else None
    if origin is None:
        return None
    try:
        guesses, issues = origin["guesses"], origin["issues"]
        return Provenance(
            str(origin["source"]),
            tuple(str(guess) for guess in guesses),
            tuple(QualityIssue(str(issue["reason"]), float(issue["error_probability"])) for issue in issues),
            str(origin.get("caution", "")),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: import is {origin!r:.60}, want an object with source, guesses and issues"
        ) from error
