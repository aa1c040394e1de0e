"""Doors of what users write: configs, floor maps, and the files of cameras."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from slipid.app.bench import read_bench_task
from slipid.app.bench_priors import bench_priors
from slipid.app.config import BenchMotors, given_settings, read_config
from slipid.app.floor_maps import map_files
from slipid.app.problem import read_fit_task, shape_of, with_mixed
from slipid.app.reference_robots import read_reference
from slipid.camera.calibration.calibrate import lens_from_file
from slipid.camera.calibration.points import read_points
from slipid.camera.floor.region import read_palette
from slipid.camera.frame import read_times
from slipid.camera.overhead import OverheadCamera
from slipid.camera.picture_file import read_picture
from slipid.camera.tracking.target import read_targets
from slipid.camera.video import Video, still
from slipid.data.floor_map import picture_of, read_map
from slipid.deploy.floors import FloorLookup
from slipid.lab.testsite.config import plan
from slipid.support.progress import Reporter
from slipid.support.toml_file import text_of
from tests.fuzz.door import Door
from tests.helpers import broken_logs, made_sources, motor_layouts

HERE = Path()
CONFIGS = Path(__file__).resolve().parents[2] / "configs"
ROBOT = """
[robot]
drive = "omni"
wheel_radius_m = 0.04
base_radius_m = 0.125
wheel_azimuths_deg = [60, 180, 300]
gear_ratio = 16
mass_kg = 12.0
motor = "bench.json"
[robot.limits]
speed_m_s = 0.5
[robot.sensors]
ammeter_std_a = 0.07
[[logs]]
glob = "one_surface/*/*.csv"
format = "robotino2022"
[[logs]]
glob = "mixed/*.csv"
format = "robotino2022"
map = "map.toml"
[camera]
image_centre_m = [-1.7, 0.9]
[weights.as_built]
std_kg = 0.1
kg = [4.0, 4.1, 3.9]
[weights.moved]
std_kg = 0.1
like = "as_built"
mass_kg = 1.0
place_m = [0.05, 0.0]
[parameters]
"camera.lag" = { prior = { mean = 0.05, std = 0.01 } }
"surface.*.lead" = { fixed = 0.001 }
"motor.resistance" = { prior = { mean = [5.9], std = 0.3 } }
[fit]
windows_per_piece = 4
longest_window_s = 6.0
"""
TWO_WHEELS = """
[robot]
drive = "differential"
wheel_radius_m = 0.1
track_m = 0.4
gear_ratio = 10
drives = [[1], [2]]
[[logs]]
glob = "generic/*.csv"
format = "mine"
surface = "floor"
end_poses = "ends.csv"
[layouts.mine]
ticks_per_revolution = 500
gear_ratio = 10
[layouts.mine.columns]
time = { column = "time", unit = "s" }
wheel_ticks = { columns = ["left", "right"], unit = "tick" }
current = { columns = ["left_a", "right_a"], unit = "A" }
voltage = { columns = ["left_v", "right_v"], unit = "V", scale = -1.0, offset = 0.5 }
"""
MOTOR = """
[robot]
drive = "motor"
names = ["one"]
[[logs]]
glob = "*.csv"
format = "bench"
[layouts.bench.columns]
time = { column = "t", unit = "s" }
motor_speed = { column = "w", unit = "rad/s" }
current = { column = "I", unit = "A" }
voltage = { column = "U", unit = "V" }
[parameters]
"motor.resistance" = { prior = { mean = 1.0, std = 0.3 } }
"""
PATCHED = """
schema = "slipid.map/1"
base = "gray"
extent_m = [0.0, -1.0, 2.0, 1.0]
cell_m = 0.05
[[patch]]
surface = "green"
polygon = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.3, 1.0]]
[[patch]]
surface = "red"
polygon = [[1.2, -0.8], [1.9, -0.8], [1.5, -0.2]]
"""
PICTURED = """
schema = "slipid.map/1"
picture = "map.png"
metres_per_pixel = 0.01
corner_m = [-0.5, 0.5]
[colours]
gray = "#808080"
green = "#00a000"
"""
PALETTE = """
schema = "slipid.palette/1"
[palette]
gray = "#808080"
green = "#00a000"
[region]
at_m = [[-1.1, -0.9], [1.1, -0.9], [1.1, 0.9]]
[[mask]]
at_px = [[10, 10], [50, 10], [50, 60]]
[[points]]
surface = "red"
at_m = [[0.3, 0.0], [-0.4, 0.7]]
"""
TARGETS = """
schema = "slipid.targets/1"
[[target]]
name = "robot"
dictionary = "4X4_50"
[[target.marker]]
id = 3
size_m = 0.1
height_m = 0.3
place_m = [0.1, 0.0]
yaw_deg = 30.0
[[target]]
name = "other"
[[target.board]]
first_id = 10
columns = 2
rows = 3
gap_m = 0.02
size_m = 0.1
height_m = 0.3
"""
SITE = """
seed = 0
video = ["as_built/firm/*"]
command_delay_s = 0.05
[robot]
wheel_radius_m = 0.04
base_radius_m = 0.125
[motor]
resistance_ohm = 5.9
[sensors]
voltage = true
camera_scale = 1.1
[surfaces.firm]
friction = 0.4
[maps]
site = { kind = "file", file = "map.toml" }
zones = { kind = "four_zones", surfaces = ["firm", "soft", "firm", "soft"] }
[[runs]]
kind = "headings"
surface = "firm"
load = "as_built"
step_deg = 90
speeds_m_s = [0.1, 0.2]
distance_m = 0.5
[[runs]]
kind = "curves"
surface = "firm"
load = "as_built"
count = 2
speeds_m_s = [0.1]
distance_m = 0.5
[[runs]]
kind = "rectangle"
map = "site"
"""
CAMERA = {
    "schema": "slipid.camera/1",
    "image_px": [640, 480],
    "matrix": [[600.0, 0.0, 320.0], [0.0, 601.0, 240.0], [0.0, 0.0, 1.0]],
    "distortion": [-0.08, 0.02, 0.0, 0.0],
    "rotation_from_world": [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
    "place_m": [0.1, -0.2, 2.4],
    "frame_s": 0.03,
    "scale_std": 0.002,
    "report": {
        "lens": {"poor": [], "covariance": np.eye(8).tolist(), "rms_px": 0.2},
        "poor": [],
    },
}


def _text(name: str, text: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        (folder / name).write_text(text.lstrip(), encoding="utf-8")

    return make


def _bench(folder: Path) -> None:
    """Write the parameters of a motor as `slipid motor` does."""
    known = {"resistance": (0.7, 1.1), "back_emf": (0.051, 0.052), "brush_drop": (0.2, 0.45)}
    numbers = {
        f"motor.{name}": {
            "value": sum(ends) / 2,
            "unit": "",
            "shape": [],
            "labels": [],
            "std": 0.1,
            "interval90": list(ends),
            "source": "laplace",
            "verdict": "identified",
            "provenance": "measured",
        }
        for name, ends in known.items()
    }
    content = {"schema": "slipid.identified/1", "drive": "motor", "parameters": numbers}
    (folder / "bench.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def _robot(folder: Path) -> None:
    broken_logs.write_good(folder)
    mixed = folder / "mixed" / "a.csv"
    mixed.parent.mkdir()
    mixed.write_text(broken_logs.robotino_text(heading=80.0), encoding="utf-8")
    map_text = PATCHED.replace('"green"', '"gray"').replace('"red"', '"gray"')
    _text("map.toml", map_text)(folder)
    _bench(folder)
    _text("my.toml", ROBOT)(folder)


def _two_wheels(folder: Path) -> None:
    broken_logs.write_good(folder)
    _text("ends.csv", "run,x_m,y_m,heading_deg\ngeneric/run.csv,0.2,0,0\n")(folder)
    _text("my.toml", TWO_WHEELS)(folder)


def _task(path: Path) -> Any:
    with Reporter(quiet=True) as report:
        config = read_config(HERE / "my.toml")
        map_files(config)
        task = with_mixed(read_fit_task(config, HERE, report), HERE, report)
    return task.logs, task.choices, task.robot_settings, config.content


def _motors(folder: Path) -> None:
    motor_layouts.plain(folder / "run.csv", motor_layouts.signals(rows=120))
    _text("my.toml", MOTOR)(folder)


def _bench_task(path: Path) -> Any:
    with Reporter(quiet=True) as report:
        task = read_bench_task(read_config(path), HERE, report)
    return task.records, task.choices


def _shipped(folder: Path) -> None:
    for path in CONFIGS.glob("*.toml"):
        if not path.name.startswith("testsite"):
            shutil.copy(path, folder)


def _read_shipped(path: Path) -> Any:
    config = read_config(path)
    if isinstance(config.content.robot, BenchMotors):
        return config.content
    return config.content, shape_of(config), given_settings(config.content.wheels)


def _sites(folder: Path) -> None:
    for path in CONFIGS.glob("testsite*.toml"):
        if path.name not in ("testsite.toml", "testsite_unseen.toml"):
            shutil.copy(path, folder)


def _site(folder: Path) -> None:
    _text(
        "map.toml", PATCHED.replace("gray", "firm").replace("green", "soft").replace("red", "short")
    )(folder)
    _text("site.toml", SITE)(folder)


def _planned(path: Path) -> Any:
    found = plan(path, text_of(path))
    return found.content, found.maps, found.runs


def _map_of(path: Path) -> Any:
    """Read a map and make its lookup, as `slipid floors` and the robot do."""
    picture_of(path)
    found = read_map(path)
    lookup = FloorLookup.of(found)
    return found, lookup.floor


def _pictured(folder: Path) -> None:
    import cv2

    picture = np.full((40, 60, 3), 128, np.uint8)
    picture[:, 30:] = (0, 160, 0)
    cv2.imwrite(str(folder / "map.png"), picture)
    _text("map.toml", PICTURED)(folder)


def _pictured_map(path: Path) -> Any:
    return _map_of(HERE / "map.toml")


def _geojson(folder: Path) -> None:
    square = [[-1.0, -0.5], [0.2, -0.5], [0.2, 0.9], [-1.0, 0.9], [-1.0, -0.5]]
    hole = [[-0.5, 0.0], [-0.2, 0.0], [-0.2, 0.3], [-0.5, 0.3], [-0.5, 0.0]]
    other = [[0.2, -0.5], [1.0, -0.5], [1.0, 0.9], [0.2, 0.9], [0.2, -0.5]]
    about = {
        "schema": "slipid.map/2",
        "base": "gray",
        "extent_m": [-1.0, -0.6, 1.0, 1.0],
        "cell_m": 0.05,
        "colours": {"gray": "#808080", "green": "#00a000"},
        "picture_sha256": "0" * 64,
        "unknown_share": 0.1,
        "notes": ["made"],
    }
    features = [
        {
            "type": "Feature",
            "properties": {"surface": name, "area_m2": 1.0, "colour": colour, "confidence": 3.0},
            "geometry": {"type": "Polygon", "coordinates": rings},
        }
        for name, colour, rings in (
            ("gray", "#808080", [square, hole]),
            ("green", "#00a000", [other]),
        )
    ]
    content = {"type": "FeatureCollection", "slipid": about, "features": features}
    (folder / "map.geojson").write_text(json.dumps(content, indent=1), encoding="utf-8")


def _camera(folder: Path) -> None:
    (folder / "camera.json").write_text(json.dumps(CAMERA, indent=1), encoding="utf-8")


def _cameras(path: Path) -> Any:
    camera, lens = OverheadCamera.load(path), lens_from_file(path)
    middle = np.array([[320.0, 240.0]])
    return camera, lens.lens, lens.covariance, camera.on_plane(middle, 0.0)


def _points(folder: Path) -> None:
    rows = [
        f"{100 * u + 50},{80 * v + 40},{0.2 * u},{0.2 * v},0" for u in range(4) for v in range(3)
    ]
    (folder / "points.csv").write_text("\n".join(["u,v,x,y,z", *rows]) + "\n", encoding="utf-8")


def _times(folder: Path) -> None:
    rows = [f"{k},{0.033 * k:.4f}" for k in range(30)]
    (folder / "times.csv").write_text("\n".join(["frame,time", *rows]) + "\n", encoding="utf-8")


def _picture(folder: Path) -> None:
    import cv2

    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (24, 32, 3), np.uint8)
    for suffix in ("png", "jpg", "bmp"):
        cv2.imwrite(str(folder / f"picture.{suffix}"), picture)


def _videos(folder: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 32, (16, 48, 64), np.uint8) + np.arange(64, dtype=np.uint8)
    made_sources.encoded(folder / "video.mp4", pictures)
    made_sources.encoded(folder / "video.mkv", pictures, codec="mpeg4")
    made_sources.encoded(folder / "video.avi", pictures, codec="mjpeg", pixels="yuvj420p")


def _video(path: Path) -> Any:
    video = Video.at(path, None, None)
    found = [frame.time for frame in video.frames()]
    return found, still(path).picture, video.image_px, video.count


def _priors(path: Path) -> Any:
    return bench_priors(read_config(HERE / "my.toml"), 16.0)


def _references(folder: Path) -> None:
    for path in (CONFIGS / "robots").glob("*.json"):
        shutil.copy(path, folder)


DOORS = (
    Door("config_robot", _robot, _task, ("my.toml",), weight=0.5),
    Door("config_two_wheels", _two_wheels, _task, ("my.toml",), weight=0.5),
    Door("config_named_files", _robot, _task, ("map.toml", "bench.json"), weight=0.5),
    Door("config_motor", _motors, _bench_task, ("my.toml",)),
    Door("config_shipped", _shipped, _read_shipped),
    Door("test_site", _site, _planned, ("site.toml",)),
    Door("test_site_shipped", _sites, _planned, weight=0.5),
    Door("map_patches", _text("map.toml", PATCHED), _map_of),
    Door("map_picture", _pictured, _pictured_map),
    Door("map_geojson", _geojson, _map_of),
    Door("palette", _text("palette.toml", PALETTE), read_palette),
    Door("targets", _text("targets.toml", TARGETS), read_targets),
    Door("camera", _camera, _cameras),
    Door("points", _points, lambda path: read_points(path, (640, 480))),
    Door("times", _times, read_times),
    Door("picture", _picture, read_picture),
    Door("video", _videos, _video, weight=0.2),
    Door("bench_priors", _robot, _priors, ("bench.json",)),
    Door("reference_robot", _references, read_reference),
)
