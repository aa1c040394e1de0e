"""A run as one file, as files at three rates, and as a bag of every kind, is the same run."""

from functools import partial

import numpy as np
import pytest

from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.data.reading.presets import declared_layout
from slipid.data.reading.reader import read_runs
from slipid.data.windows import windows
from tests.helpers import made_bags as bags

RADIUS = 0.1
START = 1_721_300_000.0
"""Start of the run, since 1970 [s]."""
WHEELS, AMPS = START + np.arange(0.0, 6.0, 0.01), START + np.arange(0.001, 6.0, 0.1)
POSES = START + np.sort(np.arange(0.01, 5.9, 0.04) + np.random.default_rng(1).uniform(0, 0.03, 148))
JOINTS = ["left_wheel", "right_wheel"]


def angle(t):
    on = np.maximum(np.asarray(t) - START - 0.5, 0.0)
    return np.stack([3.0 * on + 0.2 * np.sin(on), 2.0 * on], axis=-1)


def pose(t):
    turned = angle(t)
    yaw = 0.2 * (turned[..., 1] - turned[..., 0])
    return np.stack([0.1 * turned.mean(axis=-1), 0.02 * (np.asarray(t) - START), yaw], axis=-1)


def amps(t):
    k = np.round((np.asarray(t) - START) * 10).astype(int)
    return np.random.default_rng(0).normal(0.5, 0.1, (100, 2))[k]


def lines(path, names, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    text = [",".join("" if x is None else f"{x:.17g}" for x in row) for row in rows]
    path.write_text("\n".join([",".join(names), *text]) + "\n")


COLUMNS = {
    "wheel_angle": {"columns": ["l", "r"], "unit": "rad"},
    "current": {"columns": ["il", "ir"], "unit": "A"},
    "pose_x": {"column": "x", "unit": "m"},
    "pose_y": {"column": "y", "unit": "m"},
    "pose_heading": {"column": "yaw", "unit": "rad"},
}
TIME = {"column": "t", "unit": "s"}


def one_file(root):
    rows = [(t, *angle(t), *[None] * 5) for t in WHEELS]
    rows += [(t, None, None, *amps(t), None, None, None) for t in AMPS]
    rows += [(t, *[None] * 4, *pose(t)) for t in POSES]
    names = ["t", "l", "r", "il", "ir", "x", "y", "yaw"]
    lines(root / "run.csv", names, sorted(rows, key=lambda row: row[0]))
    return "run.csv", declared_layout({"columns": {"time": TIME, **COLUMNS}}, "test")


def three_files(root):
    parts = {
        "joint_states.csv": (WHEELS, angle, ["l", "r"]),
        "power.csv": (AMPS, amps, ["il", "ir"]),
        "mocap.csv": (POSES, pose, ["x", "y", "yaw"]),
    }
    for name, (time, values, names) in parts.items():
        lines(root / "run" / name, ["t", *names], [(t, *values(t)) for t in time])

    def columns(*channels):
        return {"columns": {"time": TIME, **{c: COLUMNS[c] for c in channels}}}

    beside = {
        "power.csv": columns("current"),
        "mocap.csv": columns("pose_x", "pose_y", "pose_heading"),
    }
    layout = declared_layout({**columns("wheel_angle"), "beside": beside}, "test")
    return "run/joint_states.csv", layout


def bag(root, storage):
    states = bags.joint_states("/joint_states", WHEELS, JOINTS, position=angle(WHEELS))
    motors = bags.joint_states("/motors", AMPS, JOINTS, effort=amps(AMPS))
    kind = "geometry_msgs/msg/PoseStamped"
    poses = [
        bags.Message("/mocap", kind, bags.pose_fields(kind, float(t), *pose(t).tolist()), float(t))
        for t in POSES
    ]
    path = root / f"run{bags.SUFFIX[storage]}"
    bags.write_bag(path, storage, bags.in_order(states, motors, poses))
    layout = declared_bag_layout(
        {
            "joints": JOINTS,
            "topics": {
                "wheel_angle": {"topic": "/joint_states"},
                "current": {"topic": "/motors", "unit": "A"},
                "pose": {"topic": "/mocap"},
            },
        },
        "test",
    )
    return path.name, layout


FORMS = {
    "three files": three_files,
    **{storage: partial(bag, storage=storage) for storage in bags.STORAGES},
}


def read(root, form):
    pattern, layout = form(root)
    return read_runs(root, pattern, layout, surface="floor")


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return windows(read(tmp_path_factory.mktemp("one"), one_file), RADIUS, 0.1, longest=0.5)


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_a_run_has_the_same_windows(tmp_path, plain, form):
    """Stamps of bags are whole nanoseconds, and seconds since 1970 round to a quarter of 1 us."""
    data = read(tmp_path, FORMS[form])
    w = windows(data, RADIUS, 0.1, longest=0.5)
    assert len(w) == len(plain) > 2
    for name in ("dt", "turn", "speed_change", "pose", "current", "current_var"):
        np.testing.assert_allclose(getattr(w, name), getattr(plain, name), atol=3e-6, err_msg=name)


def test_a_sensor_is_counted_as_often_as_it_was_read(plain):
    """Windows of half a second have five readings of an ammeter at 10 Hz, not fifty."""
    noise = plain.current_var * np.round(plain.dt / 0.1)[..., None]
    assert np.median(noise) == pytest.approx(0.1**2, rel=0.5)
