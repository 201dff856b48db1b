"""What tests of lots share: refusals in one line, and the map of Dragon Lake."""

from pathlib import Path

import pytest

from parkenv.errors import InputError
from parkenv.lots import check_lot

DRAGON_LAKE = Path(__file__).parents[2] / "shared" / "data" / "dlp" / "parking_map.yml"
needs_dragon_lake = pytest.mark.skipif(not DRAGON_LAKE.exists(), reason="Dragon Lake's map is not here")


def refusal(call, *arguments, **options):
    """The one line with which a call refuses its input."""
    with pytest.raises(InputError) as caught:
        call(*arguments, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def refused_lot(read, path):
    """The line with which a reader refuses a file; it begins with the file, and its check has an error too."""
    line = refusal(read, path)
    assert line.startswith(f"{path}: ")
    assert "error" in {problem.severity for problem in check_lot(path)}
    return line
