"""`slipid track`: interrupted, killed, and called again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from slipid.camera.frame_source import open_source
from slipid.camera.tracking import detections, tracking
from slipid.camera.tracking.detector import MarkerTracker
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.helpers.made_sources import write_video
from tests.helpers.made_videos import Body, Printed
from tests.helpers.said import KeptMessages
from tests.helpers.track_command import COUNT, LONE, OTHER, ROBOT, STAGE, Made, made_in, track

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    return made_in(tmp_path_factory.mktemp("videos"))


def run_through(
    made: Made, out: Path, monkeypatch, *words: object, stop: int | None = None
) -> list[int]:
    """Track, and return the numbers of the searched frames, interrupted in one of them."""
    searched: list[int] = []
    detect = MarkerTracker.detect

    def watched(self, grey, number):
        if number == stop:
            raise KeyboardInterrupt
        searched.append(number)
        return detect(self, grey, number)

    with monkeypatch.context() as patch:
        patch.setattr(MarkerTracker, "detect", watched)
        done = track(made, made.video("robot", ROBOT), out, *LONE, "--id", 0, *words)
    assert done.exit_code == (0 if stop is None else 130)
    return searched


def test_an_interrupted_run_goes_on_and_gives_the_same(made, tmp_path, monkeypatch):
    whole, part = tmp_path / "whole.csv", tmp_path / "part.csv"
    assert run_through(made, whole, monkeypatch) == list(range(COUNT))
    assert run_through(made, part, monkeypatch, stop=12) == list(range(12))
    assert not part.exists()
    assert run_through(made, part, monkeypatch) == list(range(12, COUNT))
    assert not (tmp_path / ".part.csv.unfinished").exists()
    one, other = pd.read_csv(whole), pd.read_csv(part)
    assert one["flag"].equals(other["flag"])
    np.testing.assert_allclose(other[["x", "y"]], one[["x", "y"]], atol=2e-5)
    np.testing.assert_allclose(other["heading"], one["heading"], atol=2e-4)


def test_checkpoints_of_other_work_are_not_used(made, tmp_path, monkeypatch):
    out = tmp_path / "p.csv"
    run_through(made, out, monkeypatch, stop=12)
    kept = tmp_path / ".p.csv.unfinished" / "sightings.npz"
    assert kept.exists()
    data = kept.read_bytes()
    kept.write_bytes(data[: len(data) // 2])
    assert run_through(made, out, monkeypatch, stop=10) == list(range(10))
    video = made.video("robot", ROBOT)
    status = video.stat()
    os.utime(video, ns=(status.st_atime_ns, status.st_mtime_ns + 10**9))  # another file
    assert run_through(made, out, monkeypatch, stop=9) == list(range(9))
    part = ("--region", "0,0,480,269")
    assert run_through(made, out, monkeypatch, *part) == list(range(COUNT))


def test_a_freeze_is_noticed_across_an_interrupt(made, tmp_path, monkeypatch):
    pictures = STAGE.film([ROBOT], 14)
    pictures[8] = pictures[7]
    frozen = Made(tmp_path)
    STAGE.camera.save(frozen.camera)
    write_video(tmp_path / "robot.avi", pictures)
    advance = Reporter.advance

    def stopped(self, done, total, what=None):
        advance(self, done, total, what)
        if done == 8:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Reporter, "advance", stopped)
        assert track(frozen, tmp_path / "robot.avi", tmp_path / "p.csv", *LONE).exit_code == 130
    assert run_through(frozen, tmp_path / "p.csv", monkeypatch) == list(range(9, 14))
    flags = pd.read_csv(tmp_path / "p.csv")["flag"]
    assert flags.tolist() == ["ok"] * 8 + ["repeated"] + ["ok"] * 5


def test_poses_that_cannot_be_written_are_kept(made, tmp_path, monkeypatch):
    source = open_source(str(made.video("robot", ROBOT)))
    target = tracking.LoneMarker(0.131, 0.25, 0).target(source, KeptMessages())
    monkeypatch.setattr(detections, "CHECKPOINT_S", 0.0)
    done = tracking.track(source, STAGE.camera, (target,), tmp_path / "kept", KeptMessages())
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(DataError, match="cannot be written"):
        done.write(tmp_path / "file" / "p.csv")
    assert (tmp_path / "kept" / "sightings.npz").exists()
    done.write(tmp_path / "p.csv")
    assert not (tmp_path / "kept").exists()


def test_a_marker_that_comes_late_is_detected_among_others(tmp_path):
    """Another marker lies in view from the start on; that is reported, and no reason to stop."""
    late = Body(lambda t: np.array([9.0, 0, 0]) if t < 3.5 else ROBOT.pose_at(t), (Printed(id=1),))
    still = STAGE.film([OTHER], 1)
    video = write_video(tmp_path / "a.avi", [*still * 104, *STAGE.film([OTHER, late], 110)[104:]])
    source, messages = open_source(str(video)), KeptMessages()
    target = tracking.LoneMarker(0.131, 0.25, 1).target(source, KeptMessages())
    done = tracking.track(source, STAGE.camera, (target,), tmp_path / "kept", messages)
    assert done.tracks[0].good[106:].all()
    assert any("marker 1 is in no frame so far, but marker 7" in line for line in messages.lines)


@pytest.mark.slow
def test_killed_in_the_middle_it_goes_on(made, tmp_path):
    """A process of its own, killed after its first checkpoint, then started again."""
    video = made.video("long", ROBOT, count=400)
    code = (
        "from slipid.camera.tracking import detections; detections.CHECKPOINT_S = 0.05\n"
        "from slipid.cli.main import main; main()"
    )
    words = ["track", video, "--camera", made.camera, "--out", tmp_path / "p.csv", *LONE]
    command = [sys.executable, "-c", code, *map(str, words)]
    kept = tmp_path / ".p.csv.unfinished" / "sightings.npz"
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE) as run:
        while run.poll() is None and not kept.exists():
            time.sleep(0.01)
        run.send_signal(signal.SIGKILL)
        run.communicate()
    assert run.returncode == -signal.SIGKILL
    assert not (tmp_path / "p.csv").exists()
    done = track(made, video, tmp_path / "p.csv", *LONE[:-1])
    assert done.exit_code == 0
    assert "resuming at frame" in done.stderr
    assert track(made, video, tmp_path / "q.csv", *LONE).exit_code == 0
    one, other = pd.read_csv(tmp_path / "q.csv"), pd.read_csv(tmp_path / "p.csv")
    assert one["flag"].equals(other["flag"])
    np.testing.assert_allclose(other[["x", "y"]], one[["x", "y"]], atol=2e-5)
