"""Options of drives that are photographs or films: of a command, which must not wait for the modules that read them."""

from pathlib import Path

from parkenv.files.option import numbers_in, option
from parkenv.files.spec_file import Spec

_PANEL = {"panel": "Photographs"}


class PhotoOptions(Spec):
    """What photographs or a film do not say of themselves."""

    poses: Path | None = option(
        None, "Poses: a table (.csv) or a track (.gpx).", takes="FILE", default="poses.csv beside them", **_PANEL
    )  # fmt: skip
    fov: float | None = option(
        None, "Horizontal field of view of the camera.", takes="DEG", default="that of --calibration", gt=1.0, lt=170.0,
        **_PANEL,
    )  # fmt: skip
    mount: tuple[float, float, float] = option(
        (1.3, -90.0, 0.0), "With --fov: the camera's height, m, yaw (-90: to the right) and pitch, degrees.",
        takes="M,DEG,DEG", default="1.3,-90,0", parse=lambda text: tuple(numbers_in(text, 3)), strict=False, **_PANEL,
    )  # fmt: skip
    origin: tuple[float, float] | None = option(
        None, "The lot's origin, for poses in degrees.", takes="LAT,LON", default="that of a lot file in degrees",
        parse=lambda text: tuple(numbers_in(text, 2)), strict=False, **_PANEL,
    )  # fmt: skip
    clock_offset: float = option(0.0, "Seconds to add to the pictures' times.", takes="S", **_PANEL)
    fps: float | None = option(
        None, "Pictures per second; the first is at the first pose.", takes="N", default="Exif times; a film's own",
        gt=0.0, le=1000.0, **_PANEL,
    )  # fmt: skip
    pose_error: float | None = option(
        None, "Standard deviation of poses, m.", takes="M", default="0; in degrees 3", ge=0.0, le=1e3, **_PANEL
    )  # fmt: skip
