"""A linear classifier of image windows, and its file."""

from __future__ import annotations

import io
import json
import math
import zipfile
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array
from parkenv.errors import InputError, require_number
from parkenv.files.atomic_write import atomic_write
from parkenv.files.limited_reading import parse_arrays, parse_json, read_arrays
from parkenv.perception.hog import Descriptor

PACKAGED_MODELS = ("side", "front")  # packaged models, trained only on simulated images
_FORMAT = "parkenv-car-model"
_VERSION = 2  # version 1 did not take the square root of the grey values
_EPOCH = (1980, 1, 1, 0, 0, 0)  # equal models are equal files


@dataclass(frozen=True, eq=False)
class CarModel:
    """A linear classifier (support vector machine) of image windows on HOG features (T §3.2.1)."""

    descriptor: Descriptor  # the features of a window
    weights: Float32Array  # `descriptor.shape` float32
    bias: float  # added to the weighted sum; a score above 0 means car
    region_aspect: float  # width over height of the image region that is resized to the window
    # left, top, right, bottom of the car within the window, as fractions of its width and height
    car: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    # slope and offset; the probability of a score s is 1/(1 + exp(-(slope·s + offset)))
    calibration: tuple[float, float] = (1.0, 0.0)
    end_on: bool = False  # whether it was trained on fronts and rears rather than on sides
    trained_on: str = ""  # one line that describes the training data

    def __post_init__(self) -> None:
        weights = np.ascontiguousarray(self.weights, dtype=np.float32)
        if weights.shape != self.descriptor.shape or not np.isfinite(weights).all():
            raise InputError(f"weights are {weights.shape}, want finite {self.descriptor.shape}")
        object.__setattr__(self, "weights", weights)
        left, top, right, bottom = self.car
        if not (0.0 <= left < right <= 1.0 and 0.0 <= top < bottom <= 1.0):
            raise InputError(f"car is {self.car}, want fractions left < right, top < bottom of the window")
        require_number("region_aspect", self.region_aspect, above=0.0)
        slope, offset = self.calibration
        if not (math.isfinite(self.bias) and math.isfinite(offset) and 0.0 < slope < math.inf):
            raise InputError(
                f"bias is {self.bias}, calibration {self.calibration}, want finite numbers, the slope above 0"
            )

    def probability(self, score: Float32Array) -> Float32Array:
        slope, offset = self.calibration
        return np.asarray(1.0 / (1.0 + np.exp(-(slope * score + offset))), dtype=np.float32)

    def scores(self, crops: NDArray[np.uint8]) -> Float32Array:
        flat = self.weights.reshape(-1)
        return np.array([self.descriptor.describe(c) @ flat + self.bias for c in crops], dtype=np.float32)

    def save(self, path: Path) -> None:
        """Write the model to an `.npz` file of about 10 kB; equal models give equal bytes."""
        settings = {
            "format": _FORMAT,
            "version": _VERSION,
            "window": [self.descriptor.width, self.descriptor.height],
            "normalization": self.descriptor.normalization,
            "bias": self.bias,
            "region_aspect": self.region_aspect,
            "car": list(self.car),
            "calibration": list(self.calibration),
            "ends": self.end_on,
            "trained_on": self.trained_on,
        }
        parts: dict[str, NDArray[Any]] = {
            "settings": np.frombuffer(json.dumps(settings, sort_keys=True).encode(), dtype=np.uint8),
            "weights": self.weights,
        }
        with (
            atomic_write(path) as unfinished,
            zipfile.ZipFile(unfinished, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            for name, array in parts.items():
                data = io.BytesIO()
                np.save(data, array, allow_pickle=False)
                archive.writestr(
                    zipfile.ZipInfo(f"{name}.npy", _EPOCH), data.getvalue(), zipfile.ZIP_DEFLATED
                )

    @classmethod
    def load(cls, name: str | Path) -> CarModel:
        if str(name) in PACKAGED_MODELS:
            source = resources.files("parkenv.perception") / "models" / f"{name}.npz"
            parts = parse_arrays(source.read_bytes(), str(name))
        elif Path(name).is_file():
            parts = read_arrays(name)
        else:
            raise InputError(f"{name}: no such model; want {', '.join(PACKAGED_MODELS)}, or an .npz file")
        settings = parse_json(parts.get("settings", np.zeros(0)).tobytes() or b"0", str(name))
        if "weights" not in parts or not isinstance(settings, dict) or settings.get("format") != _FORMAT:
            raise InputError(f"{name}: not a car model; want an .npz file that parkenv train-detector wrote")
        weights = parts["weights"]
        if settings.get("version") != _VERSION:
            raise InputError(
                f"{name}: format version {settings.get('version')!r:.40}, want {_VERSION}: "
                "written by another version of parkenv"
            )
        try:
            return cls(
                Descriptor(settings["window"][0], settings["window"][1], settings["normalization"]),
                weights,
                float(settings["bias"]),
                float(settings["region_aspect"]),
                tuple(float(v) for v in settings["car"]),  # type: ignore[arg-type]  # checked when made
                tuple(float(v) for v in settings["calibration"]),  # type: ignore[arg-type]
                bool(settings["ends"]),
                str(settings["trained_on"]),
            )
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(f"{name}: the model's settings: {error}") from error
