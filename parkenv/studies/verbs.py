"""Run studies from Python, each by one call: the functions of `parkenv` that return results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from parkenv.studies.compare.comparison import Comparison
from parkenv.studies.curve.study import CurveStudy
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.runner import Result, run
from parkenv.studies.sensing.survey_study import SurveyStudy
from parkenv.studies.study import Progress, Study
from parkenv.studies.training.spec import TrainingSpec


def compare(
    *,
    folder: Path | str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    **fields: Any,
) -> Result:
    """Compare agents over scenarios and settings, all in the same worlds.

    Args:
        folder: where the results go; None for a temporary folder that lasts as long as the result.
        resume: continue an earlier run in the folder.
        overwrite: replace another run in the folder.
        progress: called as rows finish; see `parkenv.studies.study.Progress`.
        fields: fields of the specification, as in a file of kind `compare`: `agents`, `scenarios`, `grid`, `episodes`,
            `seed` and others.

    Raises:
        InputError: a field is unknown or out of range, or the folder cannot be used.
    """
    return _run(Comparison, fields, folder, resume, overwrite, progress)


def fleet(
    *,
    folder: Path | str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    **fields: Any,
) -> Result:
    """Simulate days of many cars that search a lot; compare lots and kinds of information.

    Args:
        folder: see `compare`.
        resume: see `compare`.
        overwrite: see `compare`.
        progress: see `compare`.
        fields: fields of the specification, as in a file of kind `fleet`: `agents`, `scenarios`, `knows`, `shares`,
            `arrivals_per_hour`, `days` and others.

    Raises:
        InputError: see `compare`.
    """
    return _run(FleetStudy, fields, folder, resume, overwrite, progress)


def curve(
    *,
    folder: Path | str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    **fields: Any,
) -> Result:
    """Fit search time, walk and more in a town as functions of occupancy and demand; see `load_curves`.

    Args:
        folder: see `compare`.
        resume: see `compare`.
        overwrite: see `compare`.
        progress: see `compare`.
        fields: fields of the specification, as in a file of kind `curve`: `scenarios`, `arrivals_per_hour`, `days`,
            `reach_m` and others.

    Raises:
        InputError: see `compare`.
    """
    return _run(CurveStudy, fields, folder, resume, overwrite, progress)


def survey(
    *,
    folder: Path | str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    **fields: Any,
) -> Result:
    """Drive past every slot with simulated sensors; the result's folder holds the map, `map.sqlite`.

    Args:
        folder: see `compare`.
        resume: see `compare`.
        overwrite: see `compare`.
        progress: see `compare`.
        fields: fields of the specification, as in a file of kind `survey`: `scenario`, `sessions`, `rig`, `detector`,
            `every` and others.

    Raises:
        InputError: see `compare`.
    """
    return _run(SurveyStudy, fields, folder, resume, overwrite, progress)


def train(
    *,
    folder: Path | str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    **fields: Any,
) -> Result:
    """Train agents by reinforcement learning, one model per seed, and test them; the result's folder holds the models.

    Args:
        folder: see `compare`.
        resume: see `compare`; each training continues from its checkpoint.
        overwrite: see `compare`.
        progress: see `compare`.
        fields: fields of the specification, as in a file of kind `train`: `env`, `algorithm`, `scenarios`, `steps`,
            `trainings`, `seed` and others.

    Raises:
        InputError: see `compare`.
    """
    return _run(TrainingSpec, fields, folder, resume, overwrite, progress)


def _run(
    kind: type[Study],
    fields: dict[str, Any],
    folder: Path | str | None,
    resume: bool,
    overwrite: bool,
    progress: Progress | None,
) -> Result:
    study = kind.parse(fields, f"parkenv.{kind.model_fields['kind'].default}()")
    return run(
        study, folder, resume=resume, overwrite=overwrite, progress=progress or (lambda *_: None), command=()
    )
