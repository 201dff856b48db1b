"""Recordings for the Rerun viewer: what is in the file, read back by Rerun's own program."""

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from command_line import parkenv

from parkenv import Scenario, make_scenario
from parkenv.envs.perception import SearchPerceptionEnv
from parkenv.errors import InputError
from parkenv.mapping.survey import Survey, SurveyFrame, SurveySettings
from parkenv.studies.trips.sensor_log import GRID_EVERY, record_search, record_session, sensor_log
from planners import make_agent


def rows_of(path: Path) -> Counter[str]:
    """How often each entity was logged, according to `rerun rrd print`."""
    told = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(path)], capture_output=True, text=True, check=True
    ).stdout
    rows: Counter[str] = Counter()
    for n, name in re.findall(r"^Chunk\(\w+\) with (\d+) rows \(.*?\) - (/\S+) - ", told, re.MULTILINE):
        rows[name] += int(n)
    return rows


@pytest.fixture(scope="module")
def mini() -> Scenario:
    return make_scenario("mini")


def test_a_search_through_sensors_is_recorded_step_by_step(mini: Scenario, tmp_path: Path) -> None:
    env = SearchPerceptionEnv(mini, captures=1, weather="sunny")
    with sensor_log(tmp_path / "search.rrd", mini.lot, env.rig) as log:
        record_search(env, make_agent("mdp", env.scenario), 3, log)
    entities = rows_of(tmp_path / "search.rrd")
    assert {"/car", "/car/right", "/car/right/boxes", "/scan/0", "/lot/slots", "/lot/lanes", "/path"} <= set(
        entities
    )
    assert entities["/car"] == entities["/path"] == entities["/scan/0"] > 1
    assert list(tmp_path.iterdir()) == [tmp_path / "search.rrd"]


def test_two_drives_follow_each_other_on_one_time_line(mini: Scenario, tmp_path: Path) -> None:
    survey = Survey(mini, SurveySettings(every=8.0, weather="overcast"))
    moments: list[SurveyFrame] = []
    survey.drive(0, on_frame=moments.append)
    with sensor_log(tmp_path / "one.rrd", mini.lot, survey.pipeline.rig) as log:
        record_session(survey, 0, log)
    with sensor_log(tmp_path / "two.rrd", mini.lot, survey.pipeline.rig) as log:
        record_session(survey, 0, log)
        record_session(survey, 0, log)
    one, two = rows_of(tmp_path / "one.rrd"), rows_of(tmp_path / "two.rrd")
    assert one["/car"] == len(moments)
    assert two["/car"] == 2 * len(moments)
    assert one["/grid"] == -(-len(moments) // GRID_EVERY)


def test_who_watches_a_session_changes_nothing_and_sees_the_truth(mini: Scenario) -> None:
    survey = Survey(mini, SurveySettings(every=8.0, weather="overcast"))
    moments: list[SurveyFrame] = []
    watched, alone = survey.drive(0, on_frame=moments.append), survey.drive(0)
    assert np.array_equal(watched.states.p_occupied, alone.states.p_occupied)
    assert np.array_equal(watched.truth, alone.truth)
    assert [m.result.captured.time for m in moments] == sorted(m.result.captured.time for m in moments)
    assert moments[0].truth.shape == (mini.lot.n_slots,)


def test_a_failed_recording_leaves_nothing(mini: Scenario, tmp_path: Path) -> None:
    rig = SearchPerceptionEnv(mini).rig
    with pytest.raises(RuntimeError, match="torn"), sensor_log(tmp_path / "torn.rrd", mini.lot, rig):
        raise RuntimeError("torn")
    assert not list(tmp_path.iterdir())


def test_without_the_viewer_it_says_how_to_get_it(
    mini: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("parkenv.studies.trips.sensor_log.find_spec", lambda _: None)
    rig = SearchPerceptionEnv(mini).rig
    with pytest.raises(InputError, match=r"parkenv\[viewer\]"), sensor_log(tmp_path / "a.rrd", mini.lot, rig):
        pass


def test_compare_records_its_first_search_where_it_looks_through_sensors(tmp_path: Path) -> None:
    command = ["compare", "--scenario", "mini", "--agents", "mdp", "-n", "1", "--no-figures"]
    command += [
        "--occupancy-levels",
        "none",
        "--out",
        str(tmp_path / "out"),
        "--rerun",
        str(tmp_path / "s.rrd"),
    ]
    refused = parkenv(*command)
    assert refused.returncode == 2
    assert "add --rig laser" in refused.stderr
    done = parkenv(*command, "--rig", "laser", "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert rows_of(tmp_path / "s.rrd")["/car/right/boxes"] > 1
