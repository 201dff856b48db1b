"""Detectors by name."""

import hashlib
from importlib import resources
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.known_names import DETECTOR_SUFFIXES, DETECTORS
from parkenv.files.limited_reading import is_there
from parkenv.files.user_class import file_of_class, load_class
from parkenv.perception.car_model import PACKAGED_MODELS
from parkenv.perception.detector import LEAST_PROBABILITY, Detector
from parkenv.perception.hog_detector import HogDetector
from parkenv.perception.onnx_detector import OnnxDetector, sidecar_of

# Folder of the packaged models: NAME.npz of a HOG model, NAME.onnx with NAME.toml of a network.
MODELS = resources.files("parkenv.perception") / "models"
DEFAULT_DETECTOR = "hog"  # both packaged models, `side` and `front`


def make_detector(name: str | Detector | None = None, threshold: float | None = None) -> Detector:
    """Make a detector.

    Args:
        name: `hog` (the packaged HOG models, of sides and of fronts and rears), `net` (the packaged network), `side` or
            `front` (one HOG model), the path of a model file written by `parkenv train-detector` (`.npz`) or of a
            network (`.onnx`, see `OnnxDetector`), or `MODULE:CLASS` for a custom detector (see `Detector`; the module
            may be in the working directory). A detector is returned unchanged; None is `hog`.
        threshold: least probability of a box of the packaged detectors and of files; None: `LEAST_PROBABILITY`, of a
            network that of its settings.

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
    least = LEAST_PROBABILITY if threshold is None else threshold
    if name == DEFAULT_DETECTOR:
        return HogDetector.load(threshold=least)
    if name in PACKAGED_MODELS:
        return HogDetector.load(name, threshold=least)
    if name in DETECTORS:
        return OnnxDetector.load(str(MODELS / f"{name}.onnx"), threshold, is_known=True)
    if name.lower().endswith(".onnx"):
        return OnnxDetector.load(name, threshold)
    if name.lower().endswith(DETECTOR_SUFFIXES) or (is_there(name) and Path(name).is_file()):
        return HogDetector.load(name, threshold=least)
    if ":" in name:
        made: Detector = _class(name)()
        return made
    raise InputError(
        f"unknown detector {name!r:.80}; want {', '.join(DETECTORS)}, a file (.npz, .onnx) or MODULE:CLASS"
    )


def detector_version(name: str) -> str:
    """Return the name with a hash of its file: a model, a network (with its settings) or a module.

    A model or network that is moved keeps its version.

    Args:
        name: as for `make_detector`.
    """
    files = detector_files(name)
    shown = Path(name).name if files else name
    if not files and ":" in name:
        _class(name)
        files = [file for file in (file_of_class(name),) if file is not None]
    content = b"".join(file.read_bytes() for file in files)
    return f"{shown}@{hashlib.sha256(content).hexdigest()[:8]}" if files else name


def detector_files(name: str) -> list[Path]:
    """Return the files that a name stands for: the model, and the settings beside a network; none for other names."""
    if name in DETECTORS or not is_there(name) or not Path(name).is_file():
        return []
    beside = [sidecar_of(name)] if name.lower().endswith(".onnx") else []
    return [Path(name), *(file for file in beside if file.is_file())]


def _class(name: str) -> Any:
    return load_class(name, "detector", "detect(image)")
