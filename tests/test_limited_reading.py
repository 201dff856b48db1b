"""Files from anywhere: what is too large, too deep or damaged is refused in one line before memory is taken."""

import csv
import gzip
import io
import os
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from lot_checks import refusal

from parkenv import InputError
from parkenv.files import csv_tables, limited_reading
from parkenv.files.csv_tables import TEXT, csv_text, typed_records
from parkenv.files.images import decode_image
from parkenv.lots import packaged_lot
from parkenv.mapping.store import MapStore
from parkenv.studies.training.curve_file import read_curve

DEEP = 100_000
EVALUATION = {"steps": "0", "total_s": "80.0", "low_s": "nan", "wall_s": "4.5"}


def npy(descr="'<f8'", shape="(2,)", content=bytes(16), version=b"\x01\x00"):
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + content


def zipped(**members):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return data.getvalue()


def png(width, height, rows=b""):
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = {b"IHDR": head, b"IDAT": zlib.compress(rows), b"IEND": b""}
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*its) for its in chunks.items())


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (limited_reading.read_json, "[" * DEEP, "not JSON: nested deeper than 200 levels"),
        (limited_reading.read_json, '{"a":' * DEEP, "not JSON: nested deeper than 200 levels"),
        (limited_reading.read_json, b"\xff\xfe", "not UTF-8 text"),
        (limited_reading.read_toml, "a = " + "[" * DEEP, "not TOML: nested deeper"),
        (limited_reading.read_toml, ".".join("a" * DEEP) + " = 1", "not TOML: nested deeper"),
        (limited_reading.read_yaml, "[" * DEEP, "not YAML: nested deeper than 100 levels"),
    ],
)
def test_a_text_that_is_too_deep_or_damaged_is_refused(tmp_path, read, content, message):
    path = tmp_path / "file"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert len(str(caught.value)) < 500


def test_json_is_read_exactly(tmp_path):
    text = '\ufeff{"a": [1, -0.1, 1e-300, true, null, "é\\u0000"], "b": 9007199254740993}'
    (tmp_path / "a").write_text(text)
    wanted = {"a": [1, -0.1, 1e-300, True, None, "é\0"], "b": 9007199254740993}
    assert limited_reading.read_json(tmp_path / "a") == wanted


def test_bytes_are_counted_unpacked(tmp_path):
    (tmp_path / "a.gz").write_bytes(gzip.compress(bytes(10_000_000)))
    assert len(limited_reading.read_bytes(tmp_path / "a.gz", 10_000_000)) == 10_000_000
    with pytest.raises(InputError, match="has more than 9,999,999 bytes"):
        limited_reading.read_bytes(tmp_path / "a.gz", 9_999_999)
    (tmp_path / "a.gz").write_bytes(gzip.compress(b"abc" * 1000)[:-9])
    assert "not a whole gzip file" in refusal(limited_reading.read_bytes, tmp_path / "a.gz")


@pytest.mark.parametrize("name", ["absent", ".", "a\0b", "\ud800", "x" * 300])
def test_what_cannot_be_opened_is_named(tmp_path, name):
    with pytest.raises(InputError) as caught, limited_reading.open_limited(tmp_path / name):
        pass
    str(caught.value).encode()


def test_pipes_devices_and_files_that_state_no_size_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    # Containers put plain files where devices usually are.
    devices = [name for name in ("/dev/zero", "/dev/tty") if Path(name).is_char_device()]
    for name in ("pipe", "link", *devices):
        with pytest.raises(InputError, match=r"is a pipe or a device, want a file|No such"):
            limited_reading.read_bytes(tmp_path / name)
    assert "is not a file" in refusal(MapStore, tmp_path / "pipe", packaged_lot("mini"), create=False)
    for name in ("proc", "proc.gz"):
        (tmp_path / name).symlink_to("/proc/version")  # /proc/kmsg, which waits, needs rights
        assert limited_reading.read_bytes(tmp_path / name) == b""


def test_csv_rows_have_one_width(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text('a,b\n1,"2\n3"\n\n4')
    assert next(limited_reading.csv_records(path)) == (3, {"a": "1", "b": "2\n3"})
    assert "line 5: has 1 fields, want 2" in refusal(list, limited_reading.csv_rows(path))
    path.write_text("a\n" + "x" * 200_000)
    assert "line 2: not CSV: field larger" in refusal(list, limited_reading.csv_rows(path))


def test_a_zip_is_measured_before_it_is_unpacked():
    data = zipped(card="{}", data=b"x" * 1000)
    assert limited_reading.parse_zip(data, "a") == {"card": b"{}", "data": b"x" * 1000}
    with pytest.raises(InputError, match="unpacks to 1,002 bytes, want at most 500"):
        limited_reading.parse_zip(data, "a", 500)
    with pytest.raises(InputError, match="holds 10,001 files"):
        limited_reading.parse_zip(zipped(**{str(i): "" for i in range(limited_reading.MAX_MEMBERS + 1)}), "a")
    assert "not a zip archive" in refusal(limited_reading.parse_zip, b"PK\x03\x04 no zip", "a")
    otherwise = io.BytesIO()
    with zipfile.ZipFile(otherwise, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("a", b"x" * 1000)
    assert "deflate" in refusal(limited_reading.parse_zip, otherwise.getvalue(), "a")


def test_arrays_are_read_as_numpy_wrote_them(tmp_path):
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "c": np.array("name"),
        "d": np.zeros((0, 3), np.float32),
    }
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    read = limited_reading.read_arrays(tmp_path / "a.npz")
    assert read.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype
        assert read[name].flags.writeable


@pytest.mark.parametrize(
    "member",
    [
        npy(shape="(100000000000,)"), npy(shape="(1000000, 1000000)"), npy(shape="(-1, -2)"), npy(shape="(3,)"),
        npy("'|O'"), npy("'V0'", "(10**30,)"), npy("'nonsense'"), npy(version=b"\x09\x00"), npy(shape="(" * 5000),
        npy(shape="-" * 8000 + "1"), np.lib.format.magic(1, 0), b"",
    ],
)  # fmt: skip
def test_an_array_is_as_large_as_its_header_says(member):
    with pytest.raises(InputError, match=r"a\.npz: a\.npy: not an array of numbers"):
        limited_reading.parse_arrays(zipped(**{"a.npy": member}), "a.npz")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (png(100_000, 100_000), "is too large .* want at most 100,000,000 pixels"),
        (png(11_000, 10_000), "is too large .11000×10000 px."),
        (b"P5 100000 100000 255\n", "is too large"),
        (b"P5 10000000000 1 255\n", "is not a complete image"),
        (b"P5 10 10 255\n" + bytes(99), "is not a complete image"),
        (png(10, 10, bytes(110))[:44], "is not a complete image"),
        (b"\xff\xd8\xff\xe0\x00\x10JFIF", "is not a complete image"),
        (b"", "is not a complete image"),
    ],
)
def test_an_image_is_measured_before_it_is_decoded(data, message):
    with pytest.raises(InputError, match=message):
        decode_image(data, "a.png")


def write(path, row):
    path.write_text(f"{','.join(row)}\n{','.join(row.values())}\n")
    return path


def test_good_tables_are_read(tmp_path):
    (evaluation,) = read_curve(write(tmp_path / "curve.csv", EVALUATION), ("steps", "total_s"))
    assert (evaluation["steps"], evaluation["total_s"]) == (0, 80.0)
    assert read_curve(tmp_path / "none.csv") == []


@given(st.lists(st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0")), min_size=1))
@example(["=1+1", "'=1+1", "''=1", "+A1", "-cmd", "@x", "-5", "+1e3", "'quoted'", "", "\tx", "\rx", "a=1"])
def test_texts_are_no_formulas_in_spreadsheets_and_are_read_as_they_were(texts):
    table = csv_text(["text", "number"], [{"text": text, "number": -1.5} for text in texts], header=True)
    for cell, number in list(csv.reader(io.StringIO(table, newline="")))[1:]:
        assert number == "-1.5"
        if cell.startswith(("=", "+", "-", "@", "\t", "\r")):
            float(cell)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "table.csv"
        file.write_bytes(table.encode())
        kinds = {"text": TEXT, "number": csv_tables.NUMBER}
        rows = [row for _, row in typed_records(file, kinds.__getitem__)]
    assert [row["text"] for row in rows] == texts
    assert all(row["number"] == -1.5 for row in rows)
