"""Frames and their times: videos, folders of pictures, devices, and errors in them."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from fractions import Fraction
from unittest.mock import Mock

import av
import cv2
import numpy as np
import pytest

from slipid.camera.frame import (
    READ_AHEAD,
    cut_off,
    even_times,
    grey_of,
    read_ahead,
    read_times,
    uneven,
)
from slipid.camera.frame_source import Device, open_source
from slipid.camera.video import VideoStream
from slipid.support.errors import DataError
from tests.helpers.made_sources import InMemory, encoded, write_video

COUNT = 12


def pictures(count: int = COUNT) -> list[np.ndarray]:
    """Return grey pictures whose level encodes their number."""
    return [np.full((48, 64), 15 * (k % 17), np.uint8) for k in range(count)]


def numbers(source, first: int = 0) -> list[int]:
    return [round(float(frame.grey.mean()) / 15) for frame in source.frames(first)]


def write_times(path, rows):
    path.write_text("frame,time\n" + "".join(f"{a},{b}\n" for a, b in rows), encoding="utf-8")
    return path


def write_uneven(path, ticks):
    """Write a video whose frames have times of their own, in milliseconds."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for picture, tick in zip(pictures(len(ticks)), ticks, strict=True):
            frame = av.VideoFrame.from_ndarray(np.repeat(picture[..., None], 3, axis=2), "rgb24")
            frame.pts, frame.time_base = tick, Fraction(1, 1000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


# videos -----------------------------------------------------------------------------------------


def test_a_video_gives_its_frames_and_times(tmp_path):
    video = open_source(str(write_video(tmp_path / "a.avi", pictures(), 25.0)))
    assert (video.image_px, video.count) == ((64, 48), COUNT)
    assert numbers(video) == list(range(COUNT))
    frames = list(video.frames())
    assert [frame.index for frame in frames] == list(range(COUNT))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(COUNT) / 25, atol=1e-6)
    assert uneven([frame.time for frame in frames]) is None
    assert cut_off(video, COUNT) is None


def test_frames_from_a_number_on_are_the_same(tmp_path):
    video = open_source(str(write_video(tmp_path / "a.avi", pictures())))
    every = list(video.frames())
    later = list(video.frames(5))
    assert [frame.index for frame in later] == list(range(5, COUNT))
    for one, other in zip(every[5:], later, strict=True):
        assert one.time == other.time
        assert np.array_equal(one.grey, other.grey)


def test_rate_and_times_of_the_user_come_first(tmp_path):
    path = write_video(tmp_path / "a.avi", pictures())
    assert [f.time for f in open_source(str(path), fps=10.0).frames()][:3] == [0.0, 0.1, 0.2]
    rows = [(k, 5 + 0.04 * k + 0.001 * (k % 3)) for k in range(COUNT)]
    timed = open_source(str(path), times=write_times(tmp_path / "t.csv", rows))
    np.testing.assert_allclose([f.time for f in timed.frames()], [t for _, t in rows])
    with pytest.raises(DataError, match="both --fps and --times are given"):
        open_source(str(path), fps=10.0, times=tmp_path / "t.csv")


def test_times_too_few_or_too_many(tmp_path):
    path = write_video(tmp_path / "a.avi", pictures())
    few = write_times(tmp_path / "few.csv", [(k, 0.1 * k) for k in range(COUNT - 1)])
    with pytest.raises(DataError, match="more frames than the 11 given times"):
        list(open_source(str(path), times=few).frames())
    many = write_times(tmp_path / "many.csv", [(k, 0.1 * k) for k in range(COUNT + 1)])
    video = open_source(str(path), times=many)
    assert "12 frames, but 13 times" in cut_off(video, len(numbers(video)))


@pytest.mark.parametrize("kind", ["avi", "mp4", "mkv"])
def test_uneven_times_are_kept_and_reported(tmp_path, kind):
    ticks = [0, 33, 66, 100, 180, 213, 246, 280, 313, 400]
    video = open_source(str(write_uneven(tmp_path / f"a.{kind}", ticks)))
    times = [frame.time for frame in video.frames()]
    if kind == "avi":  # it has a rate alone: frames that were left out are repeated, or empty
        assert np.all(np.diff(times) > 0)
        return
    np.testing.assert_allclose(times, np.array(ticks) / 1000, atol=1e-3)
    assert "the frame rate varies" in uneven(times)


def test_a_video_without_times_is_refused(tmp_path, monkeypatch):
    path = encoded(tmp_path / "a.h264", pictures())
    with pytest.raises(DataError, match=r"a\.h264: frame 0 has no time; .*--fps"):
        numbers(open_source(str(path)))
    monkeypatch.setattr(VideoStream, "time_of", lambda self, frame: 0.0)
    with pytest.raises(DataError, match=r"frame 1 has time 0\.0000 s after 0\.0000 s.*--fps"):
        numbers(open_source(str(path)))
    assert numbers(open_source(str(path), fps=30.0)) == list(range(COUNT))


def test_a_video_that_was_cut_off_gives_its_first_frames(tmp_path):
    data = write_video(tmp_path / "a.avi", pictures(60)).read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) // 2])
    video = open_source(str(tmp_path / "cut.avi"))
    frames = list(video.frames())
    assert 10 < len(frames) < 50
    assert f"only the first {len(frames)} frames are used" in video.faults[0]
    assert cut_off(video, len(frames)) is None


def test_formats_that_estimate_their_length_are_not_cut_off():
    source = InMemory.even(pictures(100))
    assert cut_off(source, 100) is None
    assert cut_off(source, 97) is None
    assert "the frames end after 96 of 100" in cut_off(source, 96)


@pytest.mark.parametrize("data", [b"", b"no video", b"RIFF" + bytes(200), bytes(5000)])
def test_files_that_are_no_video_are_refused(tmp_path, data):
    (tmp_path / "a.avi").write_bytes(data)
    with pytest.raises(DataError, match=r"a\.avi: .*expected a video"):
        open_source(str(tmp_path / "a.avi"))


def test_a_video_of_an_unknown_compression_is_refused(tmp_path):
    path = encoded(tmp_path / "a.mp4", pictures())
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzzz"))
    with pytest.raises(DataError, match=r"a\.mp4: not a video .*its kind of compression is unk"):
        open_source(str(path))


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="/proc lists no threads here")
def test_converted_frames_keep_no_threads(tmp_path):
    with VideoStream(encoded(tmp_path / "a.mp4", pictures())) as stream:
        frames = list(stream.frames())
        usual = len(os.listdir("/proc/self/task"))
        converted = [stream.picture_of(frame) for frame in frames]
        assert len(os.listdir("/proc/self/task")) <= usual
        assert len(converted) == COUNT


def test_frames_that_cannot_be_converted_are_refused(tmp_path, monkeypatch):
    with VideoStream(encoded(tmp_path / "a.mp4", pictures())) as stream:
        monkeypatch.setattr(stream, "_av", Mock(FFmpegError=ValueError))
        frame = Mock(**{"to_ndarray.side_effect": ValueError("odd"), "format.name": "hard"})
        with pytest.raises(DataError, match=r"a\.mp4: pixels of the format hard cannot be conv"):
            stream.picture_of(frame)


def test_places_without_anything(tmp_path):
    with pytest.raises(DataError, match="no such file or folder"):
        open_source(str(tmp_path / "absent.mp4"))
    with pytest.raises(DataError, match="no such file or folder"):
        open_source("a" * 5000)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other devices")
def test_a_device_that_is_no_camera_is_named_as_a_device():
    with pytest.raises(DataError, match="/dev/zero: a pipe or a device; save it to a file first"):
        open_source("/dev/zero")


def test_identity_changes_with_the_file_and_its_times(tmp_path):
    path = write_video(tmp_path / "a.avi", pictures())
    first = open_source(str(path)).identity
    assert open_source(str(path)).identity == first
    assert open_source(str(path), fps=10.0).identity != first
    write_video(path, pictures(COUNT + 1))
    assert open_source(str(path)).identity != first


# folders ----------------------------------------------------------------------------------------


def test_a_folder_gives_pictures_by_name(tmp_path):
    for k, picture in enumerate(pictures()):
        cv2.imwrite(str(tmp_path / f"f{k:03d}.png"), picture)
    (tmp_path / "notes.txt").write_text("no picture", encoding="utf-8")
    folder = open_source(str(tmp_path), fps=20.0)
    assert (folder.image_px, folder.count, folder.name) == ((64, 48), COUNT, str(tmp_path))
    assert numbers(folder) == list(range(COUNT))
    assert numbers(folder, 9) == [9, 10, 11]
    assert [frame.time for frame in folder.frames(2)][:2] == [0.1, 0.15]
    with pytest.raises(DataError, match="images have no times; expected --fps or --times"):
        open_source(str(tmp_path))
    with pytest.raises(DataError, match="12 images and 2 times"):
        open_source(str(tmp_path), times=write_times(tmp_path / "t.csv", [(0, 0), (1, 1)]))
    alone = open_source(str(tmp_path / "f003.png"))
    assert numbers(alone) == [3]
    cv2.imwrite(str(tmp_path / "f999.png"), np.zeros((50, 64), np.uint8))
    with pytest.raises(DataError, match=r"f999\.png: 64 x 50 pixels; expected 64 x 48"):
        numbers(open_source(str(tmp_path), fps=20.0))
    (tmp_path / "f000.png").write_bytes(b"")
    with pytest.raises(DataError, match=r"f000\.png: the file is empty"):
        numbers(open_source(str(tmp_path), fps=20.0))


def test_a_folder_without_pictures(tmp_path):
    with pytest.raises(DataError, match=r"no image; expected \.png"):
        open_source(str(tmp_path), fps=20.0)


# devices ----------------------------------------------------------------------------------------


def test_a_device_has_a_number_of_a_camera():
    with pytest.raises(DataError, match="device '9999999999999': no such number"):
        open_source("9" * 13, seconds=1.0)


def test_a_device_needs_an_end_and_has_its_own_times():
    with pytest.raises(DataError, match="expected --seconds with the recording's duration"):
        open_source("0")
    with pytest.raises(DataError, match=r"--fps or --times is given, but .* omit both"):
        open_source("/dev/video7", fps=30.0, seconds=1.0)
    with pytest.raises(DataError, match="--seconds is for devices"):
        open_source("a.avi", seconds=1.0)
    with pytest.raises(DataError, match=r"video97: OpenCV cannot open it; .* plugged in"):
        open_source("/dev/video97", seconds=1.0)


def test_a_device_gives_frames_with_times_from_zero_on(tmp_path):
    """A video stands in for the device; the test is of the clock."""
    device = Device.at(str(write_video(tmp_path / "a.avi", pictures())), 100.0)
    frames = list(device.frames())
    assert [frame.index for frame in frames] == list(range(COUNT))
    assert frames[0].time == 0.0
    assert np.all(np.diff([frame.time for frame in frames]) > 0)
    assert device.image_px == (64, 48)
    assert device.identity != Device.at(device.place, 100.0).identity
    assert len(list(replace(device, seconds=0.0).frames())) == 1


# times ------------------------------------------------------------------------------------------

WRONG_TIMES = {
    "": "first columns other than frame and time",
    "time,frame\n0,0\n": "first columns other than frame and time",
    "frame,time\n0,0\n2,1\n": "frame 2",
    "frame,time\n0,0\n1,0\n": "times that increase",
    "frame,time\n0,0\n1,nan\n": "times that increase",
    "frame,time\n0,inf\n": "times that increase",
    "frame,time\n0,-1e308\n": r"row 2: time -1e\+308; expected .* of size 1e\+10 s at most",
    "frame,time\n0,0\n1\n": "a frame number and its time",
    "frame,time\n0,zero\n": "a frame number and its time",
    "frame,time\n0,0\n\n": "a frame number and its time",
}


@pytest.mark.parametrize("text", WRONG_TIMES)
def test_wrong_times_are_refused(tmp_path, text):
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=WRONG_TIMES[text]):
        read_times(tmp_path / "t.csv")


def test_files_that_are_no_times(tmp_path):
    (tmp_path / "t.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="not CSV text"):
        read_times(tmp_path / "t.csv")
    with pytest.raises(DataError, match="expected times of frames"):
        read_times(tmp_path)
    for fps in (0.0, -1.0, 1e308, 1e-308, float("nan"), float("inf")):
        with pytest.raises(DataError, match="expected a number from 1e-05"):
            even_times(3, fps)


def test_uneven_says_nothing_of_jitter():
    rng = np.random.default_rng(0)
    time = np.arange(100) / 30
    assert uneven(time + 0.002 * rng.random(100)) is None
    assert "every 33 to 67 ms, mostly 33" in uneven(np.delete(time, 50))
    assert uneven([0.0, 5.0]) is None


# ahead ------------------------------------------------------------------------------------------


def test_frames_decoded_ahead_are_the_same_and_errors_arrive():
    source = InMemory.even(pictures())
    assert [frame.index for frame in read_ahead(source.frames())] == list(range(COUNT))

    def breaking():
        yield from source.frames()
        raise DataError("torn off")

    frames = []
    with pytest.raises(DataError, match="torn off"):
        frames.extend(read_ahead(breaking()))
    assert len(frames) == 0 or len(frames) == COUNT


def test_nobody_decodes_on_when_frames_are_no_longer_wanted():
    taken = []

    def endless():
        while True:
            taken.append(0)
            yield from InMemory.even(pictures(1)).frames()

    frames = read_ahead(endless())
    next(frames)
    frames.close()
    assert len(taken) <= READ_AHEAD + 3


def test_grey_of_pictures_with_one_or_three_colours():
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert np.array_equal(grey_of(grey), grey)
    assert np.array_equal(grey_of(grey[..., None]), grey)
    assert np.array_equal(grey_of(np.repeat(grey[..., None], 3, axis=2)), grey)
