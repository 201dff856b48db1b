"""Videos and folders of anybody's photographs: boxes with frame and time, and films."""

import cv2
import numpy as np
import pytest
from command_line import ran, refused, rows_in, summary_of

from parkenv.files.videos import Video, film
from parkenv.perception.detector import Detections

SIZE = (160, 120)
BRIGHT = f"{__name__}:Bright"


class Bright:
    """Finds the bright rectangle."""

    def detect(self, image):
        grey = image if image.ndim == 2 else image.mean(axis=2)
        rows, columns = np.nonzero(grey > 200)
        if not len(rows):
            return Detections(np.zeros((0, 4)), np.zeros(0))
        box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        return Detections(np.array([box], float), np.array([0.9]))


def drawn(k):
    image = np.full((SIZE[1], SIZE[0], 3), 40, np.uint8)
    if k != 3:
        image[40:70, 10 + 5 * k : 70 + 5 * k] = 250
    return image


@pytest.fixture
def folder(tmp_path):
    """A folder with a video of ten frames and a picture."""
    (tmp_path / "in").mkdir()
    with film(tmp_path / "in" / "drive.mp4", SIZE, 10.0) as append:
        for k in range(10):
            append(drawn(k))
    cv2.imwrite(str(tmp_path / "in" / "photo.png"), drawn(2))
    return tmp_path / "in"


def test_a_folder_of_pictures_and_videos_becomes_boxes_and_films(folder, tmp_path):
    out = tmp_path / "out"
    done = ran("detect --step 2", folder, "--detector", BRIGHT, "--out", out)
    rows = rows_in(out / "boxes.csv")
    frames = [r for r in rows if r["frame"]]
    assert [int(r["frame"]) for r in frames] == [0, 2, 4, 6, 8]
    assert [float(r["time_s"]) for r in frames] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8])
    assert [float(r["left"]) for r in frames] == pytest.approx([10, 20, 30, 40, 50], abs=3)
    (picture,) = [r for r in rows if not r["frame"]]
    assert (picture["left"], picture["view"], picture["time_s"]) == ("20.0", "side", "")
    assert picture["visible_fraction"] == ""  # this detector does not know
    summary = summary_of(out)
    assert [row["file"] for row in summary["rows"]] == [str(folder / "photo.png")]
    (video,) = summary["videos"]
    assert (video["frames"], video["boxes"], video["most_cars"]) == (5, 5, 1)
    assert "drive.mp4: 5 frames of 0.9 s, 5 boxes, at most 1 car in a frame" in done.stdout
    film = Video.of(out / "drive_cars.mp4")
    assert (film.width, film.height, film.frames, film.fps) == (*SIZE, 5, pytest.approx(5.0))
    assert (out / "photo_cars.png").is_file()


@pytest.mark.parametrize("content", [b"I am no video", None])
def test_a_video_without_frames_is_refused_in_a_line_before_any_work(folder, tmp_path, content, capfd):
    whole = (folder / "drive.mp4").read_bytes()
    (folder / "z.mp4").write_bytes(whole[:200] if content is None else content)
    said = refused("detect", folder, "--detector", BRIGHT, "--out", tmp_path / "out")
    assert "z.mp4: is not a video with readable frames, want .mp4, .mov" in " ".join(said.split())
    assert not (tmp_path / "out").exists()
    assert not capfd.readouterr().err
