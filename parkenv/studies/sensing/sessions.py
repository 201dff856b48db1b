"""The table of a survey's sessions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from parkenv.errors import InputError
from parkenv.files.csv_tables import NUMBER_OR_NAN, TEXT, WHOLE, typed_records, wholes
from parkenv.mapping.distance_bins import DISTANCE_ENDS
from parkenv.studies.results import CsvTable, Row

MAP_FILE = "map.sqlite"
"""Map of the sessions in the folder of a survey or a demo."""
ERROR_COLUMNS = ("range_error_m", "range_error_p95_m", "place_error_m", "heading_error_deg")
SESSION_COLUMNS = (
    "key", "weather", "time_s", "parked", "found", "detections", "right",
    *ERROR_COLUMNS, *(f"thesis_{name}" for name in ERROR_COLUMNS),
    "slot_accuracy", "slot_accuracy_seen", "unknown_fraction", "occupied_fraction", "seconds_per_frame",
    "cars_in_frame", "cars_detected", "odometry_error_m", "pose_error_m", "pose_error_max_m",
    "within_1_std", "within_2_std",
)  # fmt: skip


SESSION_KINDS = {
    **dict.fromkeys(("key", "weather"), TEXT),
    **dict.fromkeys(("parked", "found", "detections", "right"), WHOLE),
    **dict.fromkeys(("cars_in_frame", "cars_detected"), wholes(len(DISTANCE_ENDS))),
}
"""What a column of `sessions.csv` holds; all others hold numbers."""


@dataclass(frozen=True, eq=False)
class SessionTable(CsvTable):
    """Sessions of surveys."""

    def read(self, folder: Path) -> list[Row]:
        """See `Table`; no more cars are detected than there are."""
        path, rows = folder / self.file, []
        columns = (*self.keys, *self.columns)
        for line, row in typed_records(
            path, lambda name: SESSION_KINDS.get(name, NUMBER_OR_NAN), columns, whole_lines=True
        ):
            there, detected = (
                [int(n) for n in row[name].split()] for name in ("cars_in_frame", "cars_detected")
            )
            if any(some > most for some, most in zip(detected, there, strict=True)):
                raise InputError(
                    f"{path}: line {line}: cars_detected is {row['cars_detected']!r:.80}, want at most cars_in_frame, "
                    f"{row['cars_in_frame']!r:.80}"
                )
            rows.append(row)
        return rows


SESSIONS = SessionTable("sessions.csv", keys=SESSION_COLUMNS[:1], columns=SESSION_COLUMNS[1:], lists=None)
