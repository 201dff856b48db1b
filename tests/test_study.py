"""The runner of all studies, by a study of a user's own: what is finished stays, and resuming it changes nothing."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path
from zlib import crc32

import pytest
from test_stopped_runs import small_files
from toy_study import Toy

from parkenv import InputError
from parkenv.studies import study as studies
from parkenv.studies.runner import Interrupted, open_run, run

TOY, LONG = Toy(jobs=1), Toy(jobs=1, numbers=40)


def files_of(folder):
    return {path.name: path.read_text() for path in folder.iterdir() if path.name != "results.sqlite"}


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
    run(TOY.changed(powers=(3,), numbers=7), tmp_path, resume=True)
    kept = (tmp_path / "powers.csv").read_text().split()
    assert [line[0] for line in kept[1:]] == [*"3" * 7, *"2" * 7], "what was there stays, after the rest"


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
    assert len(Toy.table.read(tmp_path / "stopped")) == 6
    run(TOY, tmp_path / "stopped", resume=True)
    run(TOY, tmp_path / "whole")
    assert files_of(tmp_path / "stopped") == files_of(tmp_path / "whole")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The files of an unbroken run."""
    folder = tmp_path_factory.mktemp("whole")
    run(LONG, folder)
    return files_of(folder)


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
@pytest.mark.parametrize(("number", "jobs"), [(signal.SIGKILL, 1), (signal.SIGTERM, 2), (signal.SIGINT, 1)])
def test_a_killed_run_keeps_what_is_finished_and_is_resumed_to_the_same_files(tmp_path, whole, number, jobs):
    script = (
        "import signal, sys; from pathlib import Path; from toy_study import Toy\n"
        "from parkenv.cli.stop_signals import stop_signals; from parkenv.studies.runner import run\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background\n"
        "def tell(doing, done, total): print(done, flush=True)\n"
        "toy = Toy(numbers=40, pause_s=0.1, jobs=int(sys.argv[2]))\n"
        "with stop_signals(): run(toy, Path(sys.argv[1]), progress=tell)\n"
    )
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    process = subprocess.Popen(
        [sys.executable, "-c", script, tmp_path, str(jobs)],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    told = next(done for line in process.stdout if (done := int(line)) >= 8)
    process.send_signal(number)
    process.communicate()
    assert told <= len(Toy.table.read(tmp_path)) < 80
    assert (tmp_path / "powers.csv").exists() == (number != signal.SIGKILL)
    run(LONG, tmp_path, resume=True)
    assert files_of(tmp_path) == whole


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_text("this is a letter to my aunt" * 20),
        lambda file: file.write_bytes(file.read_bytes()[:3_000]),
        lambda file: file.write_bytes(file.read_bytes().replace(b'"value": 125', b'"value": 925')),
        lambda file: changed(file, "UPDATE row SET value = '7', crc32 = 3_552_281_999 WHERE name <> 'head'"),
        lambda file: changed(file, "DROP TABLE row"),
        lambda file: changed(file, "PRAGMA user_version = 9"),
        lambda file: file.unlink() or sqlite3.connect(file).executescript("CREATE TABLE row (name)"),
    ],
)
def test_a_store_that_is_no_longer_as_it_was_written_is_named(tmp_path, damage):
    run(TOY, tmp_path)
    damage(tmp_path / "results.sqlite")
    with pytest.raises(InputError, match=r"results\.sqlite: "):
        run(TOY, tmp_path, resume=True)


def changed(file, statement):
    database = sqlite3.connect(file)
    database.executescript(statement.replace("3_552_281_999", str(crc32(b"7"))))
    database.close()


def test_a_full_disk_ends_a_run_with_a_word_and_leaves_what_was_finished(tmp_path):
    wanted = r"results\.sqlite: cannot be written: .* is the disk full"
    with small_files(60_000), pytest.raises(InputError, match=wanted):
        run(LONG, tmp_path)
    assert 0 < len(Toy.table.read(tmp_path)) < 80
    assert run(LONG, tmp_path, resume=True).rows == run(LONG).rows


def test_errors_of_a_task_leave_what_was_finished(tmp_path, monkeypatch):
    power = Toy.run

    def fail(self, work, items):
        if work.power == 3:
            raise InputError("no cubes")
        return power(self, work, items)

    monkeypatch.setattr(Toy, "run", fail)
    with pytest.raises(InputError, match="no cubes"):
        run(TOY, tmp_path)
    assert len(Toy.table.read(tmp_path)) == 6
    monkeypatch.undo()
    assert run(TOY, tmp_path, resume=True).rows[1]["sum"] == 225
