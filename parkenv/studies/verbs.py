"""Run studies from Python, each by one call: the functions of `parkenv` that return results."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.curve.study import CurveStudy
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.runner import Result, run
from parkenv.studies.sensing.survey_study import SurveyStudy
from parkenv.studies.study import ExecutionSpec, Progress, Study
from parkenv.studies.training.study import TrainingStudy

_DOC = """Run a study of kind `{kind}`, as `parkenv {kind}` does.

    {about}

    Args:
        folder: where the results go; None for a temporary folder that lasts as long as the result.
        resume: continue an earlier run in the folder.
        overwrite: replace another run in the folder.
        progress: called as rows finish; see `parkenv.studies.study.Progress`.
        fields: fields of the specification, as in a file of this kind: {fields}.

    Raises:
        InputError: a field is unknown or out of range, or the folder cannot be used.
    """


def verb(study: type[Study]) -> Callable[..., Result]:
    kind = study.model_fields["kind"].default

    def run_study(
        *,
        folder: Path | str | None = None,
        resume: bool = False,
        overwrite: bool = False,
        progress: Progress = lambda *_: None,
        **fields: Any,
    ) -> Result:
        spec = study.parse(fields, f"parkenv.{kind}()")
        return run(spec, folder, resume=resume, overwrite=overwrite, progress=progress, command=())

    own = [name for name in study.model_fields if name not in {"kind", *ExecutionSpec.model_fields}]
    run_study.__name__ = run_study.__qualname__ = kind
    run_study.__doc__ = _DOC.format(kind=kind, about=study.__doc__, fields=", ".join(own))
    return run_study


compare = verb(Comparison)
fleet = verb(FleetStudy)
curve = verb(CurveStudy)
survey = verb(SurveyStudy)
train = verb(TrainingStudy)
