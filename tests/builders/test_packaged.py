"""The packaged files are what the builders build."""

import pytest
from packaged import LOTS, PACKAGED, build

from parkenv.files.known_names import PACKAGED_LOTS
from parkenv.lots import packaged_lot
from parkenv.lots.lot_files import check_lot


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("packaged")
    build(folder)
    return folder


@pytest.mark.parametrize("name", PACKAGED_LOTS)
def test_packaged_lots_are_what_their_builders_build(name, built):
    assert packaged_lot(name) == LOTS[name]()
    committed = PACKAGED / f"{name}.geojson"
    assert (built / committed.name).read_text() == committed.read_text()
    assert check_lot(committed) == []
