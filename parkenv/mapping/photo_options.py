"""Options of drives that are photographs or films: of a command, which must not wait for the modules that read them."""

from __future__ import annotations

from pathlib import Path

from parkenv.files.option import numbers_in, option
from parkenv.files.spec_file import Spec

_PANEL = {"panel": "Photographs"}


class PhotoOptions(Spec):
    """What photographs or a film do not say of themselves."""

    poses: Path | None = option(
        None,
        "Poses: a table (.csv) or a track (.gpx).",
        takes="FILE",
        default="poses.csv beside them",
        **_PANEL,
    )
    fov: float | None = option(
        None,
        "Horizontal field of view of the camera.",
        takes="DEG",
        gt=1.0,
        lt=170.0,
        default="that of --calibration",
        **_PANEL,
    )
    mount: tuple[float, float, float] = option(
        (1.3, -90.0, 0.0), "With --fov: the camera's height, m, yaw (-90: to the right) and pitch, degrees.",
        takes="M,DEG,DEG", parse=lambda text: tuple(numbers_in(text, 3)), default="1.3,-90,0", strict=False, **_PANEL,
    )  # fmt: skip
    origin: tuple[float, float] | None = option(
        None, "The lot's origin, for poses in degrees.", takes="LAT,LON", default="as the lot file's degrees say",
        parse=lambda text: tuple(numbers_in(text, 2)), strict=False, **_PANEL,
    )  # fmt: skip
    clock_offset: float = option(0.0, "Seconds to add to the pictures' times.", takes="S", **_PANEL)
    fps: float | None = option(
        None, "Pictures a second, the first at the first pose.", takes="N", gt=0.0, le=1000.0,
        default="Exif times; a film's own", **_PANEL,
    )  # fmt: skip
    pose_error: float | None = option(
        None,
        "Standard deviation of poses, m.",
        takes="M",
        ge=0.0,
        le=1e3,
        default="0; of degrees 3",
        **_PANEL,
    )
