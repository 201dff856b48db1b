"""Pictures of a survey: its map, detections, session and graph."""

from __future__ import annotations

from pathlib import Path

from parkenv.files.file_names import file_name
from parkenv.mapping.discovery import score_discovery
from parkenv.mapping.inference import predict
from parkenv.mapping.store import MapStore
from parkenv.mapping.survey import SessionResult, SurveySettings
from parkenv.show.figures import survey as pictures
from parkenv.show.plurals import plural
from parkenv.studies.results import Row
from parkenv.studies.sensing.sessions import MAP_FILE
from parkenv.studies.sensing.surveys import mean_occupancy, slots_found
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_S


def draw_survey(
    scenario: Scenario, settings: SurveySettings, row: Row, shown: SessionResult | None, folder: Path
) -> None:
    """Draw the pictures of a survey into its folder.

    Args:
        scenario: the scenario.
        settings: settings of the survey.
        row: its row of `summary.json`.
        shown: the first session, with perception results; None if it was not driven in this run.
        folder: the folder, with the map.
    """

    def path(name: str) -> Path:
        return folder / file_name(f"{name}_{scenario.name}", ".png")

    lot, window = scenario.lot, settings.windows[0]
    with MapStore(folder / MAP_FILE, lot, create=False) as store:
        log = store.log()
        found = slots_found(store, len(log.time))
    predicted = predict(log, DAY_S * window.weekdays[0] + 0.5 * (window.start_s + window.end_s))
    true = mean_occupancy(scenario.occupancy, window)
    sessions = plural(row["sessions"], "session")
    pictures.save_map(lot, predicted, true, f"{scenario.name} after {sessions}", path("map"))
    if row["detection_by_distance"]:
        title = f"{scenario.name}, rig {settings.rig}, {sessions}"
        pictures.save_detection_reach(row["detection_by_distance"], title, path("reach"))
    if shown is not None:
        pictures.save_detections(shown, path("detections"))
        pictures.save_session(lot, shown, path("session"))
        if settings.localise != "none":
            pictures.save_localisation(lot, shown, path("localised"))
        pictures.save_graph(lot, predicted, shown, path("graph"))
    pictures.save_found_slots(lot, found, score_discovery(found, lot), path("slots_found"))
