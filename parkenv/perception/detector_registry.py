"""Detectors by name."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.user_class import file_of_class, load_class
from parkenv.perception.car_model import PACKAGED_MODELS
from parkenv.perception.detector import LEAST_PROBABILITY, Detector
from parkenv.perception.hog_detector import HogDetector

DEFAULT_DETECTOR = "hog"  # both packaged models, `side` and `front`


def make_detector(name: str | Detector | None = None) -> Detector:
    """Make a detector.

    Args:
        name: `hog` (the packaged HOG models, of sides and of fronts and rears), `side` or `front` (one of them), the
            path of a model file written by `parkenv train-detector`, or `MODULE:CLASS` for a custom detector (see
            `Detector`; the module may be in the working directory). A detector is returned unchanged; None is `hog`.

    Raises:
        InputError: an unknown name, a file without a model, or a class that does not implement `Detector`.

    Examples:
        >>> len(make_detector("hog").models)
        2
    """
    if name is not None and not isinstance(name, str):
        if not callable(getattr(name, "detect", None)):
            raise InputError(f"detector is a {type(name).__name__} without a method detect(image)")
        return name
    name = name or DEFAULT_DETECTOR
    if name == DEFAULT_DETECTOR:
        return HogDetector.load(threshold=LEAST_PROBABILITY)
    if name in PACKAGED_MODELS or Path(name).is_file():
        return HogDetector.load(name, threshold=LEAST_PROBABILITY)
    if ":" in name:
        made: Detector = _class(name)()
        return made
    raise InputError(
        f"unknown detector {name!r}; want {DEFAULT_DETECTOR}, {', '.join(PACKAGED_MODELS)}, a model file (.npz) or "
        "MODULE:CLASS"
    )


def detector_version(name: str) -> str:
    """Return the name with a hash of its model or module file.

    Args:
        name: as for `make_detector`.

    Raises:
        InputError: there is no such class.
    """
    file = Path(name) if Path(name).is_file() else None
    if file is None and ":" in name:
        _class(name)
        file = file_of_class(name)
    return name if file is None else f"{name}@{hashlib.sha256(file.read_bytes()).hexdigest()[:8]}"


def _class(name: str) -> Any:
    return load_class(name, "detector", "detect(image)")
