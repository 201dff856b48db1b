"""Read files from anywhere within limits: bytes, nesting, aliases, types of values, unpacked size of archives.

Every file that a user names is read through this module or `parkenv.files.images`.
"""

import bz2
import csv
import gzip
import io
import json
import math
import os
import re
import stat
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from parkenv.errors import InputError, naming, with_extra
from parkenv.files.atomic_write import write_text

# Maximum size of a file, if its reader sets no other; 64 MB of JSON become at most about 1.5 GB in memory.
MAX_BYTES = 64_000_000
MAX_SPEC_BYTES = 1_000_000  # maximum size of TOML and YAML, which hold no data and are read slowly
# Maximum nesting of tables and lists in TOML and YAML; JSON may have 200 levels, the limit of its parser.
MAX_DEPTH = 100
_HUGE = re.compile(rb"[eE]\+?\d{3}")
_LONG_NUMBER = re.compile(rb"[0-9]{301,}")
# tomllib takes cubic time for a key of many parts.
_DEEP_KEY = re.compile(r"(?:\.[ \t]*[\w\"'-]+[ \t]*){100}")

_PACKED: dict[str, tuple[str, Callable[[Any], Any]]] = {
    ".gz": ("gzip", lambda stored: gzip.GzipFile(fileobj=stored)),
    ".tgz": ("gzip", lambda stored: gzip.GzipFile(fileobj=stored)),
    ".bz2": ("bzip2", bz2.BZ2File),
}


class Counted(io.RawIOBase):
    """A stream that fails after `most` bytes, such as an unpacked one of unknown size."""

    def __init__(self, stream: io.BufferedIOBase, most: int, name: object) -> None:
        self._stream, self._left, self._most, self._name = stream, most, most, name

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._stream.read(min(len(buffer), self._left + 1))
        self._left -= len(data)
        if self._left < 0:
            raise InputError(f"{self._name}: has more than {self._most:,} bytes, the most that is read")
        buffer[: len(data)] = data
        return len(data)


def is_there(path: str | Path) -> bool:
    """Whether there is such a file or folder; False for what cannot be a path, such as a name of 10,000 letters."""
    try:
        return Path(path).exists()
    except (OSError, ValueError):
        return False


def require_file(path: str | Path) -> None:
    """Check that a path can be opened at once: that it is a file or a folder."""
    try:
        kind = Path(path).stat().st_mode
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{str(path)!a}: is not a file's name") from error
    if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
        raise InputError(f"{path}: is a pipe or a device, want a file")


def unpacked_path(path: Path) -> Path:
    return path.with_suffix("") if path.suffix.lower() in _PACKED else path


@contextmanager
def open_limited(path: str | Path, most: int = MAX_BYTES) -> Iterator[IO[bytes]]:
    """Open a file for reading at most `most` bytes; names that end in `.gz` and `.bz2` are unpacked.

    Files that state no size, as in /proc, are empty: some of them wait for news when read.
    """
    require_file(path)
    try:
        file = Path(path).open("rb")  # noqa: SIM115  # its own errors are caught here, those of reading below
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    with file:
        packed = _PACKED.get(Path(path).suffix.lower())
        try:
            stored: io.BufferedIOBase = file if os.fstat(file.fileno()).st_size else io.BytesIO()
            stream: Any = packed[1](stored) if packed else stored
            yield io.BufferedReader(Counted(stream, most, path), 1 << 20)
        except (EOFError, zlib.error, OSError) as error:
            reason = getattr(error, "strerror", None)
            damaged = f"not a whole {packed[0]} file ({error})" if packed else error
            raise InputError(f"{path}: {reason or damaged}") from error
        except UnicodeDecodeError as error:
            raise InputError(
                f"{path}: not UTF-8 text: {error.reason} at byte {error.start}; save it as UTF-8"
            ) from error


def read_bytes(path: str | Path, most: int = MAX_BYTES) -> bytes:
    with open_limited(path, most) as file:
        return file.read()


def read_text(path: str | Path, most: int = MAX_BYTES) -> str:
    """Return the content of a text file in UTF-8, without its byte order mark."""
    with open_limited(path, most) as file:
        return file.read().decode("utf-8-sig")


def read_json(path: str | Path, most: int = MAX_BYTES, *, finite: bool = False) -> Any:
    return parse_json(read_text(path, most), str(path), finite=finite)


def parse_json(text: str | bytes, name: str, *, finite: bool = False) -> Any:
    """Return a JSON value: at most 200 levels, numbers that fit a float, `finite` if wanted, no lone surrogates."""
    data = text.encode() if isinstance(text, str) else text
    _require_short_numbers(data, name)
    try:
        value = from_json(data, allow_inf_nan=not finite)
        if finite and _HUGE.search(data):
            # An infinity that is left would not be JSON when it is written again.
            json.dumps(value, allow_nan=False)
        return value
    except ValueError as error:
        what = str(error).replace("recursion limit exceeded", "nested deeper than 200 levels")
        raise InputError(f"{name}: not JSON: {what}") from error


def read_toml(path: str | Path) -> dict[str, Any]:
    text = read_text(path, MAX_SPEC_BYTES)
    _require_short_numbers(text.encode(), str(path))
    try:
        if _DEEP_KEY.search(text):
            raise RecursionError
        tables = tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{path}: not TOML: nested deeper than {MAX_DEPTH} levels") from error
    except ValueError as error:
        raise InputError(f"{path}: not TOML: {error}") from error
    _require_shallow(tables, str(path))
    return tables


def read_yaml(path: str | Path) -> Any:
    """Return the content of a YAML file of at most `MAX_SPEC_BYTES` without aliases: what JSON could hold too."""
    with with_extra(f"{path}: YAML", "osm"):
        import yaml

    class PlainLoader(yaml.SafeLoader):
        depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise ValueError("aliases (*name) are not read")
            if self.depth == MAX_DEPTH:
                raise ValueError(f"nested deeper than {MAX_DEPTH} levels")
            self.depth += 1
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

    text = read_text(path, MAX_SPEC_BYTES)
    _require_short_numbers(text.encode(), str(path))
    try:
        content = yaml.load(text, PlainLoader)
    except (yaml.YAMLError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: not YAML: {' '.join(str(error).split())}") from error
    _require_shallow(content, str(path), plain=True)
    return content


class _PlainTree(ElementTree.TreeBuilder):
    """Refuses a document type before its entities are read, so that they cannot grow or fetch other files."""

    def doctype(self, name: str, public_id: str | None, system: str | None) -> None:
        del public_id, system
        raise InputError(f"declares the document type {name!r:.40}, want none: entities are not read")


def read_xml(path: str | Path, root: str, most: int = MAX_BYTES // 4) -> ElementTree.Element:
    """Return the root, of this name without namespace, of XML without document type; trees take 20 times as much."""
    with naming(path):
        try:
            tree = ElementTree.fromstring(read_bytes(path, most), ElementTree.XMLParser(target=_PlainTree()))
        except ElementTree.ParseError as error:
            raise InputError(f"not XML: {error}") from error
        if tree.tag.rpartition("}")[2] != root:
            raise InputError(f"root is <{tree.tag:.60}>, want <{root}>")
    return tree


def csv_rows(path: str | Path, most: int = MAX_BYTES) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a CSV file that are not empty, with their line numbers; all are as wide as the first.

    The first line tells what separates fields: commas, semicolons or tabs.
    """
    width = 0
    with open_limited(path, most) as file:
        text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
        first = text.readline()
        reader = csv.reader(chain([first], text), delimiter=max(",;\t", key=first.count))
        try:
            for row in reader:
                width = width or len(row)
                if row and len(row) != width:
                    raise InputError(f"{path}: line {reader.line_num}: has {len(row)} fields, want {width}")
                if row:
                    yield reader.line_num, row
        except csv.Error as error:
            raise InputError(f"{path}: line {reader.line_num}: not CSV: {error}") from error


def csv_records(path: str | Path, most: int = MAX_BYTES) -> Iterator[tuple[int, dict[str, str]]]:
    rows = csv_rows(path, most)
    _, header = next(rows, (0, []))
    if twice := [name for name in header if header.count(name) > 1]:
        raise InputError(f"{path}: line 1: has two columns {twice[0]!r:.80}")
    for line, row in rows:
        yield line, dict(zip(header, row, strict=True))


def _require_short_numbers(data: bytes, name: str) -> None:
    if _LONG_NUMBER.search(data):
        raise InputError(f"{name}: has a number of more than 300 digits, the most that is read")


def _require_shallow(content: Any, name: str, *, plain: bool = False) -> None:
    """Check depth, size of integers and, if `plain`, types of a parsed file; iterative, as it may be deep."""
    rest = [(content, 0)]
    while rest:
        value, depth = rest.pop()
        if depth > MAX_DEPTH:
            raise InputError(f"{name}: nested deeper than {MAX_DEPTH} levels")
        if isinstance(value, dict):
            rest += [(part, depth + 1) for pair in value.items() for part in pair]
        elif isinstance(value, list):
            rest += [(part, depth + 1) for part in value]
        elif isinstance(value, int) and abs(value) >= 1 << 63:
            raise InputError(f"{name}: has an integer above {1 << 63}")
        elif plain and not isinstance(value, str | int | float | None):
            raise InputError(f"{name}: has a {type(value).__name__} ({value!r:.40}), want text or a number")
        elif plain and isinstance(value, str) and value != value.encode(errors="replace").decode():
            raise InputError(f"{name}: has text that is not Unicode: {value!a:.40}")


MAX_MEMBERS = 10_000  # maximum number of files in an archive
_HEADER_ERRORS = (tokenize.TokenError, OverflowError, RecursionError, MemoryError)


def parse_zip(data: bytes, name: str, most: int = MAX_BYTES) -> dict[str, bytes]:
    """Return the files of a zip archive; it claims to unpack to at most `most` bytes, the library unpacks no more."""
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
            shape, _, dtype = read_header(stream)
            size = math.prod(shape) * dtype.itemsize
            if min(shape, default=0) < 0 or size != len(content) - stream.tell():
                raise ValueError(f"{dtype}{shape} in {len(content):,} bytes")
            stored = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
            arrays[member.removesuffix(".npy")] = stored
        except (ValueError, LookupError, TypeError, SyntaxError, *_HEADER_ERRORS) as error:
            raise InputError(f"{name}: {member}: not an array of numbers: {error}") from error
    return arrays


@dataclass(frozen=True)
class JsonFormat:
    """A file format; this version of the package reads and writes no other version of it."""

    name: str  # value of `"format"` in the file
    version: int
    meaning: str  # for messages

    def read(self, path: str | os.PathLike[str]) -> dict[str, Any]:
        try:
            content = read_json(Path(path))
        except InputError as error:
            raise InputError(f"{error}; want {self.meaning}") from error
        if not isinstance(content, dict) or content.pop("format", None) != self.name:
            raise InputError(f'{path}: want {self.meaning}, a JSON object with "format": "{self.name}"')
        if (version := content.pop("version", None)) != self.version:
            raise InputError(f"{path}: version is {version!r}, want {self.version}")
        return content

    def write(self, path: str | os.PathLike[str], fields: Mapping[str, Any]) -> None:
        content = {"format": self.name, "version": self.version, **fields}
        write_text(path, json.dumps(content, indent=1) + "\n")
