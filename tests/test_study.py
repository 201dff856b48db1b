"""The runner of all studies, by a study of a user's own: what is finished stays, and resuming it changes nothing."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from toy_study import Toy

from parkenv import InputError
from parkenv.studies import study as studies
from parkenv.studies.runner import Interrupted, open_run, run

TOY = Toy(jobs=1)


def files_of(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_a_study_runs_without_a_folder_and_its_result_holds_the_files():
    result = run(TOY)
    assert result.rows == [{"power": 2, "sum": 55}, {"power": 3, "sum": 225}]
    assert result.complete
    assert result.summary["command"] == ["parkenv", "run", "experiment.json"]
    folder = result.folder
    assert {"powers.csv", "summary.json", "settings.json", "experiment.json", "done.txt"} <= {
        *files_of(folder)
    }
    del result
    assert not folder.exists()


def test_workers_change_nothing_and_warnings_come_once(tmp_path):
    with pytest.warns(UserWarning, match=r"Power\(power=2\): 4 comes before 4") as warned:
        run(TOY.changed(powers=(2,), warns=True), tmp_path / "one")
    assert len(warned) == 1
    with pytest.warns(UserWarning, match="comes before 4"):
        run(TOY.changed(powers=(2,), warns=True, jobs=2), tmp_path / "two")
    one, two = files_of(tmp_path / "one"), files_of(tmp_path / "two")
    assert one.pop("experiment.json") != two.pop("experiment.json")
    assert one == two


def test_progress_counts_what_is_finished(tmp_path):
    seen = []
    run(TOY, tmp_path, progress=lambda *news: seen.append(news))
    assert seen[0] == ("Searching", 0, 12)
    assert seen[-2:] == [("Drawing figures", 0, 1), ("Drawing figures", 1, 1)]
    more = []
    run(TOY.changed(numbers=7), tmp_path, resume=True, progress=lambda *news: more.append(news))
    assert more[0] == ("Searching", 12, 14)
    assert run(TOY.changed(numbers=7)).rows == open_run_of(tmp_path).rows


def open_run_of(folder):
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(studies.STUDIES, "toy", "toy_study:Toy")
        return open_run(folder)


def test_a_finished_run_is_read_again(tmp_path):
    result = run(TOY, tmp_path)
    again = open_run_of(tmp_path)
    assert (again.study, again.rows, again.summary) == (TOY, result.rows, result.summary)
    assert again.results.of(TOY, TOY.cells()[1])[2] == {"power": 3, "number": 2, "value": 8}
    with pytest.raises(InputError, match="holds no finished run"):
        open_run(tmp_path / "none")


def test_a_folder_of_another_run_is_kept_unless_it_is_replaced(tmp_path):
    run(TOY, tmp_path)
    before = files_of(tmp_path)
    for options, message in (
        ({}, "holds a finished toy run; add --resume to go on with it"),
        ({"resume": True}, "offset was 0 in"),
    ):
        with pytest.raises(InputError, match=message):
            run(TOY.changed(offset=1), tmp_path, **options)
        assert files_of(tmp_path) == before
    assert run(TOY.changed(offset=1), tmp_path, overwrite=True).rows[0]["sum"] == 61
    with pytest.raises(InputError, match="holds no toy run to resume"):
        run(TOY, tmp_path / "new", resume=True)
    assert not (tmp_path / "new").exists()


def test_an_interrupted_run_keeps_its_rows_and_is_resumed(tmp_path, monkeypatch):
    def stop_at_five(news, done, total):
        if done == 6:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        run(TOY, tmp_path / "stopped", progress=stop_at_five)
    assert not stopped.value.result.complete
    assert stopped.value.result.rows == [{"power": 2, "sum": 55}, {"power": 3, "sum": 0}]
    partial_summary = json.loads((tmp_path / "stopped" / "summary.partial.json").read_text())
    assert partial_summary["rows"] == stopped.value.result.rows
    table = tmp_path / "stopped" / "powers.csv"
    table.write_text(table.read_text() + "3,0")  # a line that a crash tore
    run(TOY, tmp_path / "stopped", resume=True)
    run(TOY, tmp_path / "whole")
    assert files_of(tmp_path / "stopped") == files_of(tmp_path / "whole")


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_killed_run_is_resumed_to_the_same_files(tmp_path, number):
    out = tmp_path / "killed"
    script = (
        "import signal, sys; from pathlib import Path; from toy_study import Toy\n"
        "from parkenv.cli.stop_signals import stop_signals; from parkenv.studies.runner import run\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background\n"
        "with stop_signals(): run(Toy(numbers=400, pause_s=0.02, jobs=2), Path(sys.argv[1]))\n"
    )
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    process = subprocess.Popen(
        [sys.executable, "-c", script, out], env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 60.0
    while not (out / "powers.csv").exists() or len((out / "powers.csv").read_text().splitlines()) < 9:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(number)
    process.wait()
    kept = (out / "powers.csv").read_text().splitlines()
    assert 9 <= len(kept) < 800
    study = Toy(numbers=400, jobs=2)
    run(study, out, resume=True)
    run(study, tmp_path / "whole")
    assert set(kept[:-1]) <= set((out / "powers.csv").read_text().splitlines())
    assert files_of(out) == files_of(tmp_path / "whole")


def test_errors_of_a_task_leave_what_was_finished(tmp_path, monkeypatch):
    power = Toy.run

    def fail(self, work, items):
        if work.power == 3:
            raise InputError("no cubes")
        return power(self, work, items)

    monkeypatch.setattr(Toy, "run", fail)
    with pytest.raises(InputError, match="no cubes"):
        run(TOY, tmp_path)
    assert len((tmp_path / "powers.csv").read_text().splitlines()) == 7
    monkeypatch.undo()
    assert run(TOY, tmp_path, resume=True).rows[1]["sum"] == 225
