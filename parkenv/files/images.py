"""Read images from files and folders, within limits."""

import io
import re
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image as PillowImage

from parkenv.compiled.arrays import Image
from parkenv.errors import InputError
from parkenv.files.limited_reading import read_bytes

SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp")
_FORMATS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP")
MAX_PIXELS = 100_000_000


def read_image(path: Path) -> Image:
    return decode_image(read_bytes(path), str(path))


def decode_image(data: bytes, name: str) -> Image:
    """Decode an image as `read_image`; its size is read from its header before memory is taken."""
    with _opened(data, name) as image:
        width, height = image.size
        if width * height > MAX_PIXELS:
            raise PillowImage.DecompressionBombError(f"{width}×{height} px")
        if image.mode.startswith(("I", "F")):
            raise InputError(f"{name}: has more than 8 bits a channel")
        # Palettes, transparency and other colour spaces become RGB.
        return np.array(image.convert("L" if image.mode in ("1", "L") else "RGB"))


@contextmanager
def _opened(data: bytes, name: str) -> Iterator[PillowImage.Image]:
    try:
        with (
            warnings.catch_warnings(action="ignore"),
            PillowImage.open(io.BytesIO(data), formats=_FORMATS) as image,
        ):
            yield image
    except InputError:
        raise
    except PillowImage.DecompressionBombError as error:
        raise InputError(f"{name}: is too large ({error}), want at most {MAX_PIXELS:,} pixels") from error
    # Pillow raises these for damaged files.
    except (OSError, SyntaxError, ValueError, LookupError, ArithmeticError, TypeError, struct.error) as error:
        raise InputError(f"{name}: is not a complete image, want {', '.join(SUFFIXES)}") from error


def image_time(path: Path) -> str | None:
    """Return when a photograph was taken by its Exif data, a date with the zone if it has one; or None."""
    with _opened(read_bytes(path), str(path)) as image:
        exif = image.getexif().get_ifd(0x8769)
    taken, fraction, zone = (str(exif.get(tag, "")).strip(" \0") for tag in (36867, 37521, 36881))
    date = taken[:10].replace(":", "-") + taken[10:]
    return f"{date}.{f'{fraction:0<6}'[:6]}{zone}" if taken else None


def image_text(path: Path, key: str) -> str | None:
    """Return a text that a PNG file carries beside its image (of one that `read_image` has read), or None."""
    with PillowImage.open(io.BytesIO(read_bytes(path)), formats=_FORMATS) as opened:
        text = opened.info.get(key)
    return text if isinstance(text, str) else None


def images_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    files = files_in(folder, SUFFIXES)
    if not files:
        raise InputError(f"{folder}: holds no images, want some of {', '.join(SUFFIXES)}")
    return files


def files_in(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    files = (file for file in folder.rglob("*") if file.suffix.lower() in suffixes)
    # pos-9 before pos-10
    return sorted(
        files, key=lambda file: [(w, int(d or -1)) for w, d in re.findall(r"(\D*)(\d*)", str(file))]
    )
