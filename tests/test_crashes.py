"""What nobody foresaw: one line, a file with the traceback, and exit code 70."""

import errno
import re
import shlex
import subprocess
from pathlib import Path

import pytest
from command_line import PARKENV, parkenv


def failing(error):
    def fail(*_, **__):
        raise error

    return fail


@pytest.mark.parametrize("error", [KeyError("x\ny"), RecursionError("deep"), OSError(errno.EIO, "broken")])
def test_an_unforeseen_error_is_one_line_and_a_file(monkeypatch, error):
    monkeypatch.setattr("parkenv.lots.load_lot", failing(error))
    ended = parkenv("lot", "show", "mini")
    assert ended.returncode == 70
    assert ended.stderr.count("\n") == 1
    found = re.search(
        rf"parkenv: error: unforeseen {type(error).__name__}: .*report it with (\S+\.txt)\n", ended.stderr
    )
    assert "in fail" in Path(found[1]).read_text()
    Path(found[1]).unlink()


def test_a_full_disk_is_no_error_of_ours(monkeypatch):
    monkeypatch.setattr("parkenv.lots.load_lot", failing(OSError(errno.ENOSPC, "No space left on device")))
    ended = parkenv("lot", "show", "mini")
    assert (ended.returncode, ended.stderr) == (2, "parkenv: error: No space left on device\n")


@pytest.mark.parametrize(
    "words",
    [("plan", "--occupancy", "log\udcff.csv"), ("compare", "--out", "\udcff"), ("\ud800",)],
    ids=("file", "folder", "command"),
)
def test_what_is_not_utf_8_on_the_command_line_is_refused(tmp_path, words):
    """Such as the name of a file from another system; summaries could not name it, and reports not read them."""
    ended = parkenv(*words, cwd=tmp_path)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr == f"parkenv: error: {words[-1]!a} on the command line is not UTF-8\n"
    assert not list(tmp_path.iterdir())


def test_closed_streams_do_not_stop_a_command(tmp_path):
    shown = tmp_path / "mini.png"
    command = shlex.join([*PARKENV, "lot", "show", "mini", "--out", str(shown)])
    assert subprocess.run(f"{command} >&- 2>&-", shell=True).returncode == 0
    assert shown.exists()


def test_a_reader_that_ends_is_not_complained_about():
    with subprocess.Popen(
        [*PARKENV, "schema", "compare"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as command:
        command.stdout.close()
        complaints = command.stderr.read()
    assert (command.returncode, complaints) == (1, b"")
