"""Videos as files: codecs, orientation flags, interlaced frames, damage; see test_frames too."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.camera import video
from slipid.camera.frame import cut_off
from slipid.camera.frame_source import open_source
from slipid.camera.video import MARGIN, Video, VideoStream, still
from slipid.support.errors import DataError
from tests.helpers.made_sources import encoded, write_video
from tests.helpers.track_command import LONE, ROBOT, STAGE, Made, track

COUNT = 40
SHARP, LOSSLESS = {"crf": "8"}, {"qp": "0"}


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return STAGE.film([ROBOT], COUNT)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    folder = tmp_path_factory.mktemp("videos")
    STAGE.camera.save(folder / "camera.json")
    return Made(folder)


CODECS = {
    "plain.mp4": {"options": SHARP},
    "ten_bit.mp4": {"options": SHARP, "pixels": "yuv420p10le"},
    "interlaced.mpg": {"codec": "mpeg2video", "options": {"flags": "+ildct+ilme", "b": "20000000"}},
    "variable.mkv": {"codec": "libx265", "options": {"x265-params": "crf=8:log-level=none"}},
}


@pytest.mark.parametrize("name", CODECS)
def test_every_codec_gives_the_pixels_that_were_encoded(pictures, tmp_path, name):
    video = open_source(str(encoded(tmp_path / name, pictures, **CODECS[name])))
    frames = list(video.frames())
    assert len(frames) == COUNT
    np.testing.assert_allclose([f.time for f in frames], np.arange(COUNT) / 30, atol=1e-3)
    off = [np.abs(f.grey.astype(int) - p).mean() for f, p in zip(frames, pictures, strict=True)]
    assert max(off) < 4
    assert video.faults == []
    assert [note for note in video.notes if "interlaced" in note] == video.notes
    assert len(video.notes) == (name == "interlaced.mpg")


@pytest.mark.parametrize("rotation", [90, 180, 270])
def test_an_orientation_flag_is_reported_and_changes_no_pose(made, pictures, rotation):
    plain = encoded(made.folder / "plain.mp4", pictures[:8], options=LOSSLESS)
    flagged = encoded(
        made.folder / f"r{rotation}.mp4", pictures[:8], options=LOSSLESS, rotation=rotation
    )
    poses = [made.folder / f"{path.stem}.csv" for path in (plain, flagged)]
    first = track(made, plain, poses[0], *LONE)
    second = track(made, flagged, poses[1], *LONE)
    assert (first.exit_code, second.exit_code) == (0, 0)
    assert poses[0].read_text() == poses[1].read_text()
    assert "orientation" not in first.output
    assert f"orientation flag (rotation by {rotation} degrees) is not applied" in " ".join(
        second.output.split()
    )
    assert np.array_equal(still(plain).picture, still(flagged).picture)
    assert "is not applied" in still(flagged).notes[0]


def hit(path, at: float, size: int = 40):
    """Overwrite a part of a file, from a fraction of its length on."""
    data = bytearray(path.read_bytes())
    start = int(at * len(data))
    data[start : start + size] = bytes(255 - b for b in data[start : start + size])
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("name", "codec"),
    [("a.mp4", "libx264"), ("a.mkv", "libx264"), ("a.avi", "mjpeg"), ("b.avi", "mpeg4")],
)
def test_damage_is_named_and_no_damaged_frame_is_used(pictures, tmp_path, name, codec):
    pixels = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    options = {} if codec == "mjpeg" else {"g": "10"}
    path = encoded(tmp_path / name, pictures, codec=codec, pixels=pixels, options=options)
    before = [frame.grey for frame in open_source(str(path)).frames()]
    video = open_source(str(hit(path, 0.7)))
    frames = [frame.grey for frame in video.frames()]
    assert 5 < len(frames) < COUNT
    assert all(np.array_equal(*pair) for pair in zip(frames, before[: len(frames)], strict=True))
    message = " ".join([*video.faults, cut_off(video, len(frames)) or ""])
    assert name in message
    number = len(frames) if codec == "mjpeg" else len(frames) + MARGIN
    assert f"near frame {number}" in message
    assert f"first {len(frames)} frames are used" in message


def test_a_damaged_video_is_doubtful(made, pictures):
    path = hit(encoded(made.folder / "hit.mp4", pictures, options={"g": "10"}), 0.7)
    done = track(made, path, made.folder / "hit.csv", *LONE)
    assert done.exit_code == 1
    assert "DOUBTFUL" in done.output
    assert "the file is damaged or cut off there" in " ".join(done.output.split())
    assert "decoding failed near frame" in still(path).faults[0]


def test_a_damaged_beginning_is_refused(pictures, tmp_path):
    path = hit(encoded(tmp_path / "a.mp4", pictures, options={"g": "10"}), 0.1, 400)
    with pytest.raises(
        DataError, match=r"a\.mp4: decoding failed near frame \d .* only the first 0 frames"
    ):
        open_source(str(path))


def test_a_part_of_a_longer_recording_begins_at_its_first_key_frame(pictures, tmp_path):
    options = {"x264-params": "open-gop=1:keyint=15:min-keyint=15:bframes=3:scenecut=0"}
    whole = encoded(tmp_path / "whole.ts", pictures, options=options).read_bytes()
    start = int(0.25 * len(whole)) // 188 * 188
    (tmp_path / "part.ts").write_bytes(whole[start:])
    video = open_source(str(tmp_path / "part.ts"))
    frames = list(video.frames())
    assert 10 < len(frames) < COUNT
    assert frames[0].index == 0
    assert "frames at the beginning cannot be decoded" in video.notes[0]
    off = [np.abs(frames[0].grey.astype(int) - picture).mean() for picture in pictures]
    assert min(off) < 4


def test_frames_of_several_sizes_are_refused(pictures, tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.avi", pictures)
    whole = VideoStream._decoded

    class Smaller:
        width, height = 32, 24

    def changing(self):
        yield from whole(self)
        yield Smaller()

    monkeypatch.setattr(VideoStream, "_decoded", changing)
    with pytest.raises(DataError, match=r"a\.avi: frames of 32 x 24 pixels after frames of 480 x"):
        list(Video.at(path, None, None).frames())


def test_huge_frames_and_other_files_are_refused_before_decoding(pictures, tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.avi", pictures[:2])
    with monkeypatch.context() as patch:
        patch.setattr(video, "MOST_PIXELS", 480 * 270 - 1)
        patch.setattr(VideoStream, "frames", None)
        with pytest.raises(DataError, match=r"a\.avi: frames of 480 x 270 pixels; expected"):
            open_source(str(path))
    sound = tmp_path / "sound.wav"
    sound.write_bytes(b"RIFF\x24\x01\x00\x00WAVEfmt \x10\0\0\0\x01\0\x01\0\x40\x1f\0\0\x80\x3e\0\0"
                      b"\x02\0\x10\0data\x00\x01\x00\x00" + bytes(256))  # fmt: skip
    with pytest.raises(DataError, match=r"sound\.wav: .*it has no video"):
        open_source(str(sound))
