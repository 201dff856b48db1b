"""Names from files: they stay in their folder, fit its file system, and are printed as they are."""

import gc
import json
from pathlib import Path

import pytest
from command_line import parkenv, refused
from hypothesis import given
from hypothesis import strategies as st

from parkenv.files.file_names import MAX_BYTES, distinct_names, file_name
from parkenv.lots import load_lot, write_lot

HOSTILE = "..[bold]$a_{$:b*?<|> CON.txt " + "ℵ" * 50
"""A name that scenario files may have."""


@given(st.text(st.characters(exclude_categories=()), max_size=400))
def test_a_file_name_is_one_part_of_a_path_of_bounded_length(name):
    made = file_name(name, ".png")
    assert 4 < len(made.encode()) <= MAX_BYTES + 4
    assert not set(made) & set('\0/\\:*?"<>|')
    assert made[0] not in ". "
    assert file_name(made[:-4]) == made[:-4]


@pytest.mark.parametrize("name", ["campus", "Markt 5, Süd", "mdp(failure_s=90)", "日本", "x" * MAX_BYTES])
def test_a_plain_name_is_its_own_file_name(name):
    assert file_name(name) == name


def test_different_names_have_different_files():
    names = [
        "a/b", "a:b", "a_b", "..", ".", "", "con", "CON", "con.txt", "x" * 300, "x" * 301, "a\0b", "\ud800",
    ]  # fmt: skip
    assert len({file_name(name) for name in names}) == len(names)


NAMES = st.sampled_from(["a", "A", "a.png", "b"])
FILES = st.builds("{}/{}.{}".format, st.sampled_from(["x", "y"]), NAMES, st.sampled_from(["png", "jpg"]))


@given(st.lists(FILES.map(Path), max_size=12))
def test_different_files_have_distinct_names_and_one_alone_its_stem(files):
    names = distinct_names(files)
    assert len(set(names)) == len(set(files))
    stems = [file.stem.casefold() for file in set(files)]
    if len(set(stems)) == len(stems):
        assert names == [file.stem for file in files]


def lot_named(name, path):
    write_lot(load_lot("mini"), path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"name": name}))
    return path


@pytest.mark.parametrize("name", ["../x", "x" * 300, "[bold]x[/nothing] :car: $a_{$"])
def test_a_lot_is_drawn_beside_whatever_its_name_is(tmp_path, name):
    (tmp_path / "in").mkdir()
    lot_named(name, tmp_path / "lot.geojson")
    drawn = parkenv("lot", "show", "../lot.geojson", cwd=tmp_path / "in")
    assert (drawn.returncode, drawn.stderr) == (0, "")
    (picture,) = (tmp_path / "in").iterdir()
    assert picture.name == file_name(name, ".png")
    assert "".join(name.split()) in "".join(drawn.stdout.split())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "lot.geojson"]


@pytest.mark.parametrize("name", ["a\nb\0\x1b[31mred\u202eright to left", 5])
def test_a_name_that_a_terminal_would_obey_is_refused(tmp_path, name):
    lot_named(name, tmp_path / "lot.geojson")
    said = refused("lot", "show", tmp_path / "lot.geojson")
    assert "name is " in said
    assert said.rstrip("\n").isprintable()


def test_a_path_that_a_terminal_would_obey_is_printed_escaped(tmp_path):
    path = lot_named("plain", tmp_path / "\x1b[31mred\u202e.geojson")
    checked = parkenv("lot", "check", path)
    assert (checked.returncode, checked.stderr) == (0, "")
    assert r"\x1b[31mred\u202e.geojson" in checked.stdout
    assert checked.stdout.replace("\n", "").isprintable()


@pytest.mark.parametrize(
    ("command", "pictures"),
    [
        (["compare", "--agents", "greedy-drive", "--episodes", 1], ("searches", "time_distribution")),
        (["plan"], ()),
        pytest.param(["survey", "--sessions", 1, "--every", 12], ("map", "session"), marks=pytest.mark.slow),
    ],
)
def test_a_scenario_of_any_name_is_run_to_its_end(tmp_path, command, pictures):
    scenario, out = tmp_path / "in.toml", tmp_path / "out" / "run"
    scenario.write_text(f"name = '{HOSTILE}'\nlot = 'mini'\n")
    gc.collect()  # what other tests left open warns here, not in the command
    ended = parkenv(*command, "--scenario", scenario, "--out", out)
    assert (ended.returncode, ended.stderr) == (0, "")
    names = {path.name for path in out.iterdir()}
    for kind in pictures:
        assert any(n.startswith(f"{kind}_") and n.endswith(".png") for n in names), kind
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.toml", "out"]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["run"]
