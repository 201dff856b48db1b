"""Read images from files and folders, within limits."""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from parkenv.errors import InputError
from parkenv.files.limited_reading import read_bytes

Image = NDArray[np.uint8]

SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp")
_FORMATS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP")
MAX_PIXELS = 100_000_000


def read_image(path: Path) -> Image:
    """Read an image file as (h, w) grey or (h, w, 3) RGB, uint8; transparency is dropped.

    Raises:
        InputError: the file cannot be read, or see `decode_image`.
    """
    return decode_image(read_bytes(path), str(path))


def decode_image(data: bytes, name: str) -> Image:
    """Decode an image as `read_image`; its size is read from its header before memory is taken.

    Raises:
        InputError: not a whole image, more than 8 bits per channel, or over 100 million pixels; the message starts
            with `name`.
    """
    try:
        # OpenCV takes the memory that the header claims, and cannot read the header alone.
        with (
            warnings.catch_warnings(action="ignore"),
            PillowImage.open(io.BytesIO(data), formats=_FORMATS) as header,
        ):
            width, height = header.size
        if width * height > MAX_PIXELS:
            raise PillowImage.DecompressionBombError(f"{width}×{height} px")
        image = (
            None if _is_truncated(data) else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        )
    except PillowImage.DecompressionBombError as error:
        raise InputError(f"{name}: is too large ({error}), want at most {MAX_PIXELS:,} pixels") from error
    except (OSError, SyntaxError, ValueError, LookupError, ArithmeticError, struct.error, cv2.error):
        image = None
    if image is None:
        raise InputError(f"{name}: is no image that can be read whole; want {', '.join(SUFFIXES)}")
    if image.dtype != np.uint8:
        raise InputError(f"{name}: has {8 * image.dtype.itemsize} bits a channel, want 8")
    if image.ndim == 2:
        return np.asarray(image, dtype=np.uint8)
    code = {1: None, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}.get(image.shape[2])
    return np.asarray(image[..., 0] if code is None else cv2.cvtColor(image, code), dtype=np.uint8)


def image_text(path: Path, key: str) -> str | None:
    """Return a text that a PNG file carries beside its image (of one that `read_image` has read), or None."""
    with PillowImage.open(io.BytesIO(read_bytes(path)), formats=_FORMATS) as opened:
        text = opened.info.get(key)
    return text if isinstance(text, str) else None


def images_in(folder: Path) -> list[Path]:
    """Return the image files in a folder and its subfolders, in natural order of their names.

    Raises:
        InputError: the folder does not exist or contains no images.
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


def _is_truncated(data: bytes) -> bool:
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
