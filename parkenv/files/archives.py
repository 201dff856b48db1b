"""Read zip archives and NumPy's .npz within limits on their unpacked size."""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.files.limited_reading import MAX_BYTES, read_bytes

MAX_MEMBERS = 10_000
"""Maximum number of files in an archive."""
_HEADER_ERRORS = (tokenize.TokenError, OverflowError, RecursionError, MemoryError)


def parse_zip(data: bytes, name: str, most: int = MAX_BYTES) -> dict[str, bytes]:
    """Return the files of a zip archive, by name, at most `most` bytes in all when unpacked.

    Sizes are those that the archive claims; the library unpacks no more than that.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) > MAX_MEMBERS:
                raise InputError(f"{name}: holds {len(members):,} files, want at most {MAX_MEMBERS:,}")
            if (size := sum(member.file_size for member in members)) > most:
                raise InputError(f"{name}: unpacks to {size:,} bytes, want at most {most:,}")
            if {member.compress_type for member in members} - {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
                raise InputError(f"{name}: is compressed otherwise than by deflate")
            return {member.filename: archive.read(member) for member in members}
    except InputError:
        raise
    # What zipfile raises for damage, and for encryption, offsets and names that it does not read.
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, ValueError) as error:
        raise InputError(f"{name}: not a zip archive that can be read: {error}") from error


def read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an `.npz` file; see `parse_arrays`."""
    return parse_arrays(read_bytes(path), str(path))


def parse_arrays(data: bytes, name: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of `.npz` data, without pickle; sizes are checked before memory is taken."""
    arrays = {}
    for member, content in parse_zip(data, name).items():
        stream = io.BytesIO(content)
        try:
            version = np.lib.format.read_magic(stream)
            read_header = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            shape, is_fortran, dtype = read_header(stream)
            size = math.prod(shape) * dtype.itemsize
            if dtype.hasobject or min(shape, default=0) < 0 or size != len(content) - stream.tell():
                raise ValueError(f"{dtype}{shape} in {len(content):,} bytes")
            array = np.frombuffer(content, dtype, offset=stream.tell()).copy()
            arrays[member.removesuffix(".npy")] = array.reshape(shape, order="F" if is_fortran else "C")
        except (ValueError, LookupError, TypeError, SyntaxError, *_HEADER_ERRORS) as error:
            raise InputError(f"{name}: {member}: not an array of numbers: {error}") from error
    return arrays
