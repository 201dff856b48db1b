"""Reading images from files and folders."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError

Image = NDArray[np.uint8]

SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp")
_LARGEST = 100_000_000


def read_image(path: Path) -> Image:
    """Read an image file as (h, w) grey or (h, w, 3) RGB, uint8; transparency is dropped.

    Raises:
        InputError: a missing file, not an image, a truncated image, more than 8 bits per channel, or over 100 million
            pixels.
    """
    return decode_image(_bytes_of(path), str(path))


def decode_image(data: bytes, name: str) -> Image:
    """Decode an image from bytes, as `read_image`; `name` is for error messages."""
    raw = np.frombuffer(data, dtype=np.uint8)
    image = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED) if len(raw) else None
    if image is None or _torn(data):
        raise InputError(f"{name}: is no image that can be read whole; want {', '.join(SUFFIXES)}")
    if image.dtype != np.uint8:
        raise InputError(f"{name}: has {8 * image.dtype.itemsize} bits a channel, want 8")
    if image.shape[0] * image.shape[1] > _LARGEST:
        raise InputError(f"{name}: is {image.shape[1]}×{image.shape[0]} px, want at most {_LARGEST:,} pixels")
    if image.ndim == 2:
        return np.asarray(image, dtype=np.uint8)
    code = {1: None, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}.get(image.shape[2])
    return np.asarray(image[..., 0] if code is None else cv2.cvtColor(image, code), dtype=np.uint8)


def images_in(folder: Path) -> list[Path]:
    """Return the image files in a folder and its subfolders, in natural order of their names.

    Raises:
        InputError: no such folder, or one without images.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    files = sorted((f for f in folder.rglob("*") if f.suffix.lower() in SUFFIXES), key=natural_order)
    if not files:
        raise InputError(f"{folder}: holds no images, want some of {', '.join(SUFFIXES)}")
    return files


def natural_order(path: Path) -> list[tuple[str, int]]:
    """Return a sort key that puts pos-9 before pos-10."""
    return list(_parts(str(path)))


def _parts(text: str) -> Iterator[tuple[str, int]]:
    word, digits = "", ""
    for letter in text:
        if letter.isdigit():
            digits += letter
        else:
            if digits:
                yield word, int(digits)
                word, digits = "", ""
            word += letter
    yield word, int(digits or -1)


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error


def _torn(data: bytes) -> bool:
    """Return whether a PNG, JPEG or PGM file is truncated; OpenCV fills the missing part without an error."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-16:]
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" not in data[-64:]
    if data.startswith((b"P5", b"P6")):
        fields = data[:512].split()
        try:
            width, height, most = (int(f) for f in fields[1:4])
        except (ValueError, IndexError):
            return False
        return len(data) < width * height * (3 if data.startswith(b"P6") else 1) * (2 if most > 255 else 1)
    return False
