"""The formats of recorded drives: which source reads a path."""

from __future__ import annotations

from pathlib import Path

from parkenv.errors import InputError
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.drive_calibration import DriveCalibration
from parkenv.mapping.drive_folders import DriveFolder, is_drive_folder
from parkenv.mapping.drive_sources import Bag, Source
from parkenv.mapping.kitti_folders import kitti_folder
from parkenv.mapping.photo_options import PhotoOptions
from parkenv.mapping.photographs import Photographs, is_photographs


def source_of(
    path: Path,
    calibration: DriveCalibration | None,
    options: PhotoOptions,
    frame: LocalFrame | None,
    own_frame: bool = False,
) -> Source:
    """Return what reads a drive: of KITTI, of a folder that the calibration describes, of photographs, or a bag."""
    kitti = kitti_folder(path)
    if kitti is None and is_drive_folder(path, calibration) and calibration is not None:
        return DriveFolder(path, calibration, options, frame, own_frame=own_frame)
    if kitti is None and is_photographs(path):
        return Photographs(path, options, calibration, frame, own_frame=own_frame)
    if options.changed(origin=None) != PhotoOptions():
        raise InputError(f"{path}: has poses of its own, want no options of photographs but --origin")
    return kitti or Bag(path)
