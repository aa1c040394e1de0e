"""Speed and memory of reading a big bag, beside bare rosbags on the same topics.

    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_bags.py

The bag is made in a temporary folder: images that nobody wants, and beside them joint states at
500 Hz, an IMU at 200 Hz, odometry at 50 Hz and commands at 20 Hz. SLIPID_BAG_GB sets its size.
Bare iteration takes the wanted messages out of the bag and looks at none; the second has rosbags
turn each into its object as well, as whoever wants the numbers must. The hash of the files, which
reading takes too, beside it on another core, is told apart.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.quick import QUICK, quick

GB = float(os.environ.get("SLIPID_BAG_GB", quick("1", "0.02")))
IMAGE = 640 * 480 * 3
RATES = {"/camera": 10, "/joint_states": 500, "/imu": 200, "/odom": 50, "/cmd_vel": 20}
WANTED = [topic for topic in RATES if topic != "/camera"]
JOINTS = ("left", "right")
LAYOUT = {
    "joints": list(JOINTS),
    "topics": {
        "wheel_angle": {"topic": "/joint_states"},
        "wheel_speed": {"topic": "/joint_states"},
        "current": {"topic": "/joint_states", "unit": "A"},
        "gyro": {"topic": "/imu"},
        "pose": {"topic": "/odom"},
        "twist_command": {"topic": "/cmd_vel"},
    },
}


@pytest.fixture(scope="module", params=["rosbag1", "sqlite3", "mcap"])
def bag(request, tmp_path_factory):
    from tests.helpers.made_bags import SUFFIX

    path = tmp_path_factory.mktemp("bags") / f"big{SUFFIX[request.param]}"
    started = time.perf_counter()
    counts = written(path, request.param)
    size = sum(p.stat().st_size for p in ([path] if path.is_file() else path.iterdir()))
    print(
        f"\n{request.param}: {size / 1e9:.2f} GB with {counts} wanted messages, "
        f"made in {time.perf_counter() - started:.0f} s"
    )
    return path


def written(path: Path, storage: str) -> int:
    """Write the bag and return how many messages in it are wanted."""
    from tests.helpers.made_bags import message, types_of, writer_of

    store = types_of(storage)
    serialise = store.serialize_ros1 if storage == "rosbag1" else store.serialize_cdr
    length = GB * 1e9 / (IMAGE * RATES["/camera"] + 400.0 * sum(RATES[t] for t in WANTED))
    times = sorted(
        (float(t), topic)
        for topic, rate in RATES.items()
        for t in 1.7e9 + np.arange(int(length * rate)) / rate
    )
    pixels = np.random.default_rng(0).integers(0, 255, IMAGE, dtype=np.uint8)
    with writer_of(path, storage) as writer:
        connections = {}
        for t, topic in times:
            name, fields = said(topic, t, pixels)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            raw = serialise(message(store, name, fields), name)
            writer.write(connections[topic], round((t + 0.001) * 1e9), raw)
    return sum(topic != "/camera" for _, topic in times)


def said(topic: str, t: float, pixels: np.ndarray) -> tuple[str, dict]:
    """Type and fields of a message."""
    from tests.helpers.made_bags import JOINT_STATE, header, pose_fields, vector

    turn = t % 1000.0
    if topic == "/camera":
        fields = {"header": header(t, "camera"), "height": 480, "width": 640, "step": 1920}
        return "sensor_msgs/msg/Image", {**fields, "encoding": "rgb8", "data": pixels}
    if topic == "/joint_states":
        arrays = {name: [turn, -turn] for name in ("position", "velocity", "effort")}
        return JOINT_STATE, {"header": header(t), "name": list(JOINTS), **arrays}
    if topic == "/imu":
        return "sensor_msgs/msg/Imu", {"header": header(t, "imu"), "angular_velocity": vector(z=1)}
    if topic == "/odom":
        name = "nav_msgs/msg/Odometry"
        return name, pose_fields(name, t, turn, 0.0, 0.1)
    return "geometry_msgs/msg/Twist", {"linear": vector(0.1), "angular": vector()}


def bare(path: Path, *, objects: bool) -> int:
    """What rosbags does by itself; how many messages it found."""
    from rosbags.highlevel import AnyReader

    count = 0
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic in WANTED]
        for connection, _, raw in reader.messages(wanted):
            count += 1
            if objects:
                reader.deserialize(raw, connection.msgtype)
    return count


def seconds_of(path: Path) -> dict[str, float]:
    """Shortest of three times for what is compared, taken in turns [s of the processor].

    On a machine that others use as well, the time on the wall tells of them.
    """
    from slipid.data.reading.bag.layout import declared_bag_layout
    from slipid.data.reading.bag.storage import BagFiles, files_of
    from slipid.data.reading.bag.topics import topics_of
    from tests.helpers.one_bag import runs_of

    layout = declared_bag_layout(LAYOUT, "layout")
    hashed = BagFiles.sha256

    def unhashed():
        BagFiles.sha256 = property(lambda files: "")
        runs_of(path, layout)
        BagFiles.sha256 = hashed

    jobs = {
        "bare iteration": lambda: bare(path, objects=False),
        "iteration with objects": lambda: bare(path, objects=True),
        "read_bag but the hash": unhashed,
        "read_bag": lambda: runs_of(path, layout),
        "hash alone": lambda: files_of(path).sha256,
        "topics_of": lambda: topics_of(path),
    }
    taken = {name: [] for name in jobs}
    for _ in range(3):
        for name, job in jobs.items():
            started = time.process_time()
            job()
            taken[name].append(time.process_time() - started)
    return {name: min(times) for name, times in taken.items()}


def memory_of(path: Path) -> tuple[float, float]:
    """By how much reading made this process grow at most, and what of it the signals are [MiB]."""
    from slipid.data.reading.bag.layout import declared_bag_layout
    from slipid.data.reading.bag.topics import topics_of
    from tests.helpers.one_bag import runs_of

    layout = declared_bag_layout(LAYOUT, "layout")
    topics_of(path)  # imports what reading imports
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak up to here
    before = peak()
    (run,) = runs_of(path, layout)
    after = peak()
    arrays = [a for s in run.signals.values() for a in (s.time, s.values, s.source.lines)]
    return after - before, sum(a.nbytes for a in arrays) / 2**20


def peak() -> float:
    """Most memory that this process had [MiB]."""
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1024


def alone(function, path: Path):
    """What a function says in a process of its own, where types are not checked as in tests."""
    root = Path(__file__).resolve().parents[2]
    code = (
        "import json, pathlib, sys; from tests.benchmarks import bench_bags as b\n"
        f"print(json.dumps(b.{function.__name__}(pathlib.Path(sys.argv[1]))))"
    )
    said = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    return json.loads(said.stdout)


def test_reading_is_as_fast_as_bare_iteration(bag):
    best = alone(seconds_of, bag)
    for name, seconds in best.items():
        ratios = [best[how] / seconds for how in ("bare iteration", "iteration with objects")]
        print(f"{name:24s} {seconds:7.3f} s; speed over {ratios[0]:5.2f} and {ratios[1]:5.2f}")
    assert QUICK or best["iteration with objects"] / best["read_bag but the hash"] >= 0.7
    assert QUICK or best["bare iteration"] / best["read_bag but the hash"] >= 0.5


def test_memory_is_that_of_the_wanted_numbers(bag):
    grown, kept = alone(memory_of, bag)
    print(f"\nmemory grew by {grown:.0f} MiB at most; {kept:.0f} MiB of it are the signals")
    assert QUICK or grown < 10.0 * kept + 100.0
