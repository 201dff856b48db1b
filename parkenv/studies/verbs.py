"""Run studies from Python, each by one call: the functions of `parkenv` that return results."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.curve.study import CurveStudy
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.runner import Result, run
from parkenv.studies.sensing.survey_study import SurveyStudy
from parkenv.studies.study import Progress, Study
from parkenv.studies.training.spec import TrainingSpec

_DOC = """{does}

    Args:
        folder: where the results go; None for a temporary folder that lasts as long as the result.
        resume: continue an earlier run in the folder.
        overwrite: replace another run in the folder.
        progress: called as rows finish; see `parkenv.studies.study.Progress`.
        fields: fields of the specification, as in a file of kind `{kind}`: {fields} and others.

    Raises:
        InputError: a field is unknown or out of range, or the folder cannot be used.
    """


class Verb(Protocol):
    """A function that runs one kind of study."""

    def __call__(
        self,
        *,
        folder: Path | str | None = None,
        resume: bool = False,
        overwrite: bool = False,
        progress: Progress | None = None,
        **fields: Any,
    ) -> Result:
        """Run the study; see `_DOC`."""


def _verb(study_class: type[Study], does: str, fields: str) -> Verb:
    """Return the function that runs a kind of study and is named after it."""
    kind = study_class.model_fields["kind"].default

    def verb(
        *,
        folder: Path | str | None = None,
        resume: bool = False,
        overwrite: bool = False,
        progress: Progress | None = None,
        **fields: Any,
    ) -> Result:
        study = study_class.parse(fields, f"parkenv.{kind}()")
        quiet = progress or (lambda *_: None)
        return run(study, folder, resume=resume, overwrite=overwrite, progress=quiet, command=())

    verb.__name__ = verb.__qualname__ = kind
    verb.__doc__ = _DOC.format(does=does, kind=kind, fields=fields)
    return verb


compare = _verb(
    Comparison,
    "Compare agents over scenarios and settings, all in the same worlds.",
    "`agents`, `scenarios`, `grid`, `episodes`, `seed`",
)
fleet = _verb(
    FleetStudy,
    "Simulate days of many cars that search a lot; compare lots and kinds of information.",
    "`agents`, `scenarios`, `knows`, `shares`, `arrivals_per_hour`, `days`",
)
curve = _verb(
    CurveStudy,
    "Fit search time, walk and more in a town as functions of occupancy and demand; see `load_curves`.",
    "`scenarios`, `arrivals_per_hour`, `days`, `reach_m`",
)
survey = _verb(
    SurveyStudy,
    "Drive past every slot with simulated sensors; the result's folder holds the map, `map.sqlite`.",
    "`scenario`, `sessions`, `rig`, `detector`, `every`",
)
train = _verb(
    TrainingSpec,
    "Train agents by reinforcement learning, one model per seed, and test them; the folder holds the models.",
    "`algorithm`, `scenarios`, `steps`, `trainings`, `seed`",
)
