"""The packaged files are what the builders build."""

import pytest
from packaged import LOTS, PACKAGED

from parkenv.files.known_names import PACKAGED_LOTS
from parkenv.lots import check_lot, packaged_lot, write_lot


@pytest.mark.parametrize("name", PACKAGED_LOTS)
def test_packaged_lots_are_what_their_builders_build(name, tmp_path):
    built, committed = LOTS[name](), PACKAGED / f"{name}.geojson"
    write_lot(built, tmp_path / "built.geojson")
    assert packaged_lot(name) == built
    assert (tmp_path / "built.geojson").read_text() == committed.read_text()
    assert check_lot(committed) == []
