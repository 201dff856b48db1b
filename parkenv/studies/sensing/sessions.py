"""The table of a survey's sessions."""

from parkenv.studies.results import Table

MAP_FILE = "map.sqlite"  # map of the sessions in the folder of a survey or a demo
ERROR_COLUMNS = ("range_error_m", "range_error_p95_m", "place_error_m", "heading_error_deg")
SESSION_COLUMNS = (
    "key", "weather", "time_s", "parked", "found", "detections", "right",
    *ERROR_COLUMNS, *(f"thesis_{name}" for name in ERROR_COLUMNS),
    "slot_accuracy", "slot_accuracy_seen", "unknown_fraction", "occupied_fraction", "seconds_per_frame",
    "cars_in_frame", "cars_detected", "odometry_error_m", "pose_error_m", "pose_error_max_m",
    "within_1_std", "within_2_std",
)  # fmt: skip


SESSIONS = Table("sessions.csv", keys=SESSION_COLUMNS[:1], columns=SESSION_COLUMNS[1:])
