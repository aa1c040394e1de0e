"""From videos and logs without poses to identified numbers: the whole chain on the test site.

    make bench
    SLIPID_CHAIN=out/chain .venv/bin/python -m pytest -s -o python_files='bench_*.py' \
        tests/benchmarks/bench_chain.py

(about half an hour, most of it drawing the videos at 1920 x 1080; with SLIPID_CHAIN they are kept
there and drawn once). Twenty runs on two floors, of a robot with a gyro, are filmed by a camera
that was started 1.3 s before their logs. Each video is tracked, its clock is found from the motion,
and the robot is identified from that; then again with the true poses in the logs instead. Prints
how far poses and clocks are from the truth, and both fits side by side. Asserts 1.5 mm and 0.3
degrees, 3 ms rms where a gyro told the clock, and that the numbers by video lie in the 90 %
intervals of those by true poses, but for one in ten.
"""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from slipid.data.wheel_signals import interpolate
from slipid.support.files import read_json
from tests.benchmarks.quick import QUICK, quick
from tests.helpers.shared import invoke

EARLY = 1.3
STEP, FAR = quick((45, 0.6), (120, 0.4))
CONFIG = f"""
seed = 11
formats = ["slipid"]
video = ["*"]
[camera]
early_s = {EARLY}
[sensors]
gyro = true
[[runs]]
kind = "headings"
surface = "firm"
step_deg = {STEP}
speeds_m_s = [0.2]
distance_m = {FAR}
[[runs]]
kind = "headings"
surface = "soft"
step_deg = {STEP}
speeds_m_s = [0.2]
distance_m = {FAR}
[[runs]]
kind = "curves"
surface = "soft"
count = 1
[[runs]]
kind = "curves"
surface = "firm"
count = 1
"""
MARKER = ("--marker-size", "0.131", "--marker-height", "0.25", "--id", "0")
COMPARED = ("robot.load_share", "motor.", "surface.", "camera.marker_yaw")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    kept = os.environ.get("SLIPID_CHAIN")
    folder = Path(kept) if kept else tmp_path_factory.mktemp("chain")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "chain.toml").write_text(CONFIG)
    done("simulate", folder / "chain.toml", "--out", folder, "--quiet")
    camera = folder / "video" / "camera.json"
    for video in sorted((folder / "video").rglob("*.avi")):
        log = folder / "logs" / video.relative_to(folder / "video")
        poses = log.with_suffix(".poses.csv")
        done("track", video, "--camera", camera, *MARKER, "--out", poses, "--quiet")
    return folder


def done(*words):
    result = invoke(*map(str, words))
    assert result.exit_code in quick((0,), (0, 1)), f"{words}\n{result.output}"
    return result


def names(site: Path) -> list[str]:
    return [p.relative_to(site / "truth").as_posix()[:-4] for p in (site / "truth").rglob("*.npz")]


def true_poses(site: Path, name: str, at: np.ndarray) -> np.ndarray:
    with np.load(site / "truth" / f"{name}.npz") as true:
        return interpolate(true["time"], true["pose"], at)


def marker_yaw(site: Path) -> float:
    """Heading of the marker less that of the body [deg]."""
    truth = read_json(site / "truth" / "truth.json", "the truth")
    return float(truth["site"]["machine"]["marker_yaw_deg"])


def test_poses_are_where_the_robot_was(site):
    print(f"\n{'run':24}{'mm rms':>8}{'deg rms':>9}{'flagged':>9}{'NEES':>7}")
    squares, nees = [], []
    yaw = np.radians(marker_yaw(site))
    for name in sorted(names(site)):
        rows = pd.read_csv(site / "logs" / f"{name}.poses.csv")
        ok = rows[rows.flag == "ok"]
        taken = pd.read_csv(site / "video" / f"{name}.csv").time.to_numpy()[ok.frame]
        gap = ok[["x", "y", "heading"]].to_numpy() - true_poses(site, name, taken)
        gap[:, 2] = np.angle(np.exp(1j * (gap[:, 2] - yaw)))
        spread = ok[["var_x", "var_y", "var_heading"]].to_numpy()
        squares.append(gap**2)
        nees.append((gap**2 / spread).sum(axis=1))  # covariances between the three are tiny
        mm, deg = 1e3 * np.sqrt((gap[:, :2] ** 2).sum(1).mean()), np.degrees(gap[:, 2].std())
        print(f"{name:24}{mm:8.2f}{deg:9.3f}{len(rows) - len(ok):9}{nees[-1].mean():7.1f}")
    every = np.concatenate(squares)
    mm = 1e3 * np.sqrt(every[:, :2].sum(axis=1).mean())
    deg = np.degrees(np.sqrt(every[:, 2].mean()))
    inside = float((np.concatenate(nees) < 6.25).mean())
    print(f"all: {mm:.2f} mm, {deg:.3f} deg; {inside:.0%} inside 90 % regions")
    assert QUICK or mm < 1.5
    assert QUICK or deg < 0.3
    assert QUICK or inside > 0.85


def test_clocks_are_found(site):
    done("check", site / "robot_video.toml", "--data", site / "logs", "--out", site / "checked")
    clocks = read_json(site / "checked" / "check.json", "a check")["clocks"]
    print(f"\n{'run':28}{'told by':>8}{'off, ms':>9}{'+- 90 %':>9}")
    held, gyro = [], []
    for name, clock in sorted(clocks.items()):
        low, high = clock["offset_interval90_s"]
        # the camera's clock starts with the video, before the robot's by so much
        off = clock["offset_s"] + EARLY
        print(f"{name:28}{clock['told_by']:>8}{1e3 * off:9.1f}{5e2 * (high - low):9.1f}")
        held.append(low <= -EARLY <= high)
        gyro += [off] if clock["told_by"] == "gyro" else []
    assert QUICK or np.mean(held) >= 0.75
    assert QUICK or np.sqrt(np.mean(np.square(gyro))) < 0.003


def test_numbers_by_video_are_those_by_true_poses(site):
    perfect, yaw = site / "logs_true", marker_yaw(site)
    for name in names(site):
        log = pd.read_csv(site / "logs" / f"{name}.csv")
        pose = true_poses(site, name, log.time.to_numpy())
        log[["x", "y"]], log["heading"] = 1e3 * pose[:, :2], np.degrees(pose[:, 2]) + yaw
        (perfect / name).parent.mkdir(parents=True, exist_ok=True)
        log.to_csv(perfect / f"{name}.csv", index=False, float_format="%.6f")
    text = (site / "robot_video.toml").read_text()
    columns = "".join(
        f'pose_{a} = {{ column = "{a}", unit = "{u}" }}\n'
        for a, u in (("x", "mm"), ("y", "mm"), ("heading", "deg"))
    )
    beside = text[text.index("\n# what `slipid track`") : text.index("\n[[logs]]")]
    (site / "robot_true.toml").write_text(text.replace(beside, f"{columns}"))
    found = {}
    for kind, folder in (("video", site / "logs"), ("true", perfect)):
        config, out = site / f"robot_{kind}.toml", site / f"result_{kind}"
        done("identify", config, "--data", folder, "--out", out, "--quiet")
        found[kind] = read_json(out / "identified.json", "a fit")["parameters"]
    print(f"\n{'number':36}{'by video':>10}{'by true poses, 90 %':>32}")
    inside = []
    for path, true in found["true"].items():
        if not path.startswith(COMPARED) or true["verdict"] not in ("identified", "weak"):
            continue
        pairs = zip(
            *(np.atleast_1d(v) for v in (found["video"][path]["value"], true["value"])),
            np.reshape(true["interval90"], (-1, 2)),
            strict=True,
        )
        for video, value, (low, high) in pairs:
            inside.append(low <= video <= high)
            print(f"{path:36}{video:10.4g}{value:12.4g} ({low:8.4g} .. {high:8.4g})")
    print(f"{sum(inside)} of {len(inside)} inside")
    assert QUICK or np.mean(inside) >= 0.9
