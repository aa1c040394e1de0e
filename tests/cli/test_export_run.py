"""`slipid export-run`: the MCAP file says what the library predicts, and readers understand it."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections import defaultdict
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from slipid.app.config import read_config
from slipid.app.logs import read_dataset
from slipid.app.run_export.run_messages import _field_names
from slipid.data.floor_map import from_polygons, uniform, write_map
from slipid.data.runs import Runs
from slipid.fitting.variances import DEGREES
from slipid.infer.result import Fit
from slipid.predict import open_loop as replay
from slipid.predict.score import forecast
from slipid.predict.slip_model import body_poses, relative_to_start
from slipid.predict.slip_models import restored
from slipid.support.progress import Reporter
from tests.helpers.shared import invoke

pytestmark = pytest.mark.slow
RUN = "as_built/soft/run003.csv"
PATHS = ("measured", "nominal", "calibrated", "selected", "estimator")


@dataclass(frozen=True)
class Read:
    """Messages of a file as (time [ns], message) by topic, units by topic, metadata, all times."""

    messages: dict[str, list]
    units: dict[str, str]
    about: dict[str, str]
    times: list[int]

    def time(self, topic: str) -> np.ndarray:
        return np.array([time for time, _ in self.messages[topic]]) * 1e-9

    def column(self, topic: str, name: str) -> np.ndarray:
        return np.array([getattr(one, name) for _, one in self.messages[topic]])

    def poses(self, name: str) -> np.ndarray:
        found = [one.pose for _, one in self.messages[f"/pose/{name}"]]
        heading = [2 * np.arctan2(p.orientation.z, p.orientation.w) for p in found]
        place = [(p.position.x, p.position.y) for p in found]
        return np.column_stack([place, np.unwrap(heading)])


def points(cloud) -> np.ndarray:
    """Places (point, 3) of a point cloud, by its own description of its bytes."""
    offsets = {field.name: (field.offset, field.type) for field in cloud.fields}
    assert {offsets[name][1] for name in "xyz"} == {cloud.fields[0].FLOAT32}
    raw = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
    starts = [offsets[name][0] for name in "xyz"]
    return np.stack([raw[:, k : k + 4].copy().view("<f4")[:, 0] for k in starts], axis=1)


def colours(cloud) -> list[str]:
    """Colours #rrggbb of a point cloud."""
    offsets = {field.name: field.offset for field in cloud.fields}
    raw = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
    return [row.tobytes().hex() for row in raw[:, [offsets[n] for n in ("red", "green", "blue")]]]


def nearest(time: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Indices of the times that equal the wanted ones."""
    found = np.abs(time - wanted[:, None]).argmin(axis=1)
    np.testing.assert_allclose(time[found], wanted, atol=2e-9)
    return found


def read(path: Path) -> Read:
    reader = make_reader(BytesIO(path.read_bytes()), decoder_factories=[DecoderFactory()])
    messages, units, times = defaultdict(list), {}, []
    for schema, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
        assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
        assert message.publish_time == message.log_time
        if "timestamp" in decoded.DESCRIPTOR.fields_by_name:
            assert decoded.timestamp.ToNanoseconds() == message.log_time
        messages[channel.topic].append((message.log_time, decoded))
        units[channel.topic] = channel.metadata["unit"]
        times.append(message.log_time)
    (about,) = (one.metadata for one in reader.iter_metadata() if one.name == "slipid")
    return Read(dict(messages), units, about, times)


def exported(out: Path, run: str, folder: Path, *words: object) -> Read:
    done = invoke("export-run", out, run, "--out", folder / "run.mcap", "--quiet", *words)
    assert done.exit_code == 0, done.stderr
    return read(folder / "run.mcap")


def runs_of(out: Path, data: Path, name: str) -> Runs:
    config = read_config(out / "config.toml")
    return read_dataset(config, config.content.logs[:1], data, Reporter(quiet=True), name)[0]


@pytest.fixture(scope="module")
def made(small, tmp_path_factory) -> Read:
    return exported(small[0] / "out", "run003", tmp_path_factory.mktemp("made"))


@pytest.fixture(scope="module")
def run(small) -> Runs:
    return runs_of(small[0] / "out", small[0] / "logs", RUN)


@pytest.fixture(scope="module")
def fit(small) -> Fit:
    return Fit.load(small[0] / "out")


# what the file holds ----------------------------------------------------------------------------


def test_a_file_has_every_topic_in_the_order_of_time(made, run):
    poses, log = len(made.messages["/pose/measured"]), run.logs[0]
    drawn = [f"/{kind}/{name}" for kind in ("pose", "path", "robot") for name in PATHS]
    plotted = ("/floor/probability", "/floor/under_wheels", "/slip_ratio", "/wheel_speed_rad_s")
    regions = ("/region90/selected", "/region90/estimator")
    assert set(made.messages) == {*drawn, *plotted, *regions, "/tf", "/current_a"}
    assert made.times == sorted(made.times)
    assert made.times[0] == round(1e9 * log.time[0])
    counts = {topic: len(found) for topic, found in made.messages.items()}
    assert {counts[f"/{kind}/{name}"] for kind in ("path", "robot") for name in PATHS} == {1}
    assert counts["/tf"] == sum(counts[f"/pose/{name}"] for name in PATHS)
    assert counts["/region90/selected"] == counts["/pose/selected"] < poses
    assert counts["/slip_ratio"] == counts["/floor/probability"] == counts["/pose/estimator"]
    assert (made.units["/current_a"], made.units["/slip_ratio"]) == ("A", "1")
    assert made.about["run"] == RUN
    assert (made.about["fitted"], made.about["sha256"]) == ("yes", log.sha256)
    assert made.about["selected_model"] == "contact"


def test_poses_and_paths_are_those_that_the_fit_predicts(made, run, fit):
    w = replay.replay_windows(run, fit.robot)[0]
    tracks = fit.tracks(w)
    yaw = float(fit.robot.camera.yaw(fit.robot.session_index(run.session[0])))
    edges = w.start[0] - w.lag + np.concatenate([[0.0], np.cumsum(w.dt[0])])
    for name, marker in (("selected", tracks.predicted[0]), ("measured", tracks.measured[0])):
        near = nearest(made.time(f"/pose/{name}"), edges)
        found = made.poses(name)
        np.testing.assert_allclose(found[near], marker - [0.0, 0.0, yaw], atol=1e-9)
        drawn = points(made.messages[f"/path/{name}"][0][1])
        np.testing.assert_allclose(drawn, np.pad(found[:, :2], ((0, 0), (0, 1))), atol=1e-6)
    assert not fit.robot.camera.marker_place.any()
    late, models = w.at_lag(float(fit.seen.camera.lag)), dict(fit.baselines)
    for model in restored(fit.config_shape, {k: models[k] for k in ("nominal", "calibrated")}):
        increments = model.increments(late, fit.seen)
        expected = replay.tracks_from_increments(fit.seen, w, increments).predicted
        expected = body_poses(fit.seen, w.session, expected)[0]
        found = made.poses(model.name)
        np.testing.assert_allclose(found[0], made.poses("selected")[0], atol=1e-9)
        relative = relative_to_start(found)[nearest(made.time(f"/pose/{model.name}"), edges)]
        np.testing.assert_allclose(relative, relative_to_start(expected), atol=1e-9)


def test_transforms_and_robots_move_with_the_poses(made, fit):
    for name in PATHS:
        mine = [one for _, one in made.messages["/tf"] if one.child_frame_id == name]
        places = [(one.translation.x, one.translation.y) for one in mine]
        np.testing.assert_array_equal(places, made.poses(name)[:, :2])
        assert {one.parent_frame_id for one in mine} == {"map"}
        (robot,) = (one for _, one in made.messages[f"/robot/{name}"])
        assert robot.frame_id == name
        shape = fit.robot.geometry
        wheels = np.asarray(shape.place) * float(shape.base_radius)
        np.testing.assert_allclose(points(robot)[:3, :2], wheels, atol=1e-6)


def test_regions_are_those_by_which_runs_are_judged(made, run, fit):
    w = replay.replay_windows(run, fit.robot)[0]
    tracks, cov = fit.contact.ends(w)
    outlines = [points(one)[:, :2] for _, one in made.messages["/region90/selected"]]
    place = made.poses("selected")[:, :2]
    level, _ = forecast(outlines[-1] - place[-1], np.repeat(cov[:1], len(outlines[-1]), axis=0))
    np.testing.assert_allclose(level, 0.9, atol=1e-5)
    size = [np.ptp(outline, axis=0).prod() for outline in outlines]
    assert size[0] < 0.2 * size[-1]
    for outline, middle in zip(outlines, place, strict=True):
        np.testing.assert_allclose(outline.mean(axis=0), middle, atol=1e-6)
    gap = tracks.predicted[:1, -1, :2] - tracks.measured[:1, -1, :2]
    covered = forecast(gap, cov[:1], DEGREES)[0] <= 0.9
    assert covered == fit.validate(run).runs[0].models["selected"].covered90


def test_numbers_of_the_wheels_are_those_of_log_and_estimator(made, run, small):
    log, names = run.logs[0], ("wheel_1", "wheel_2", "wheel_3")
    currents = np.stack([made.column("/current_a", name) for name in names], axis=1)
    rows = nearest(log.time, made.time("/current_a"))
    np.testing.assert_array_equal(currents, log.current[rows])
    belief = [made.column("/floor/probability", name) for name in ("soft", "unknown")]
    np.testing.assert_allclose(np.sum(belief, axis=0), 1.0, atol=1e-9)
    assert belief[0][-1] > 0.9
    assert {made.column("/floor/under_wheels", name)[-1] for name in names} == {"soft"}
    speed = np.stack([made.column("/wheel_speed_rad_s", name) for name in names], axis=1)
    turned = np.sum(speed[1:] * np.diff(made.time("/wheel_speed_rad_s"))[:, None], axis=0)
    np.testing.assert_allclose(
        turned, log.wheel_angle[-1] - log.wheel_angle[0], rtol=0.02, atol=0.1
    )
    slip = np.stack([made.column("/slip_ratio", name) for name in names], axis=1)
    assert np.all((slip > -2.0) & (slip < 1.0))
    assert np.median(slip[len(slip) // 2 :], axis=0).max() > 0.1  # the floor is soft


def test_the_same_run_gives_the_same_bytes(small, tmp_path):
    out, files = small[0] / "out", [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for file in files:
        assert invoke("export-run", out, RUN, "--out", file, "--quiet").exit_code == 0
    assert files[0].read_bytes() == files[1].read_bytes()


def test_json_lists_the_topics(small, tmp_path, made):
    words = ("--out", tmp_path / "run.mcap", "--json", "-", "--quiet")
    done = invoke("export-run", small[0] / "out", RUN, *words)
    content = json.loads(done.stdout)
    assert (content["run"], content["fitted"], content["notes"]) == (RUN, "yes", [])
    assert content["topics"]["/slip_ratio"] == {
        "schema": "slipid.SlipRatio",
        "unit": "1",
        "messages": len(made.messages["/slip_ratio"]),
    }


def test_names_of_floors_are_made_different_names_of_fields():
    assert _field_names(["a b", "a-b", "3rd", "ok", "für"]) == ("a_b", "a_b_", "_3rd", "ok", "f_r")


# other runs and other results -------------------------------------------------------------------


def test_a_run_that_was_not_fitted_is_exported_from_its_own_folder(small, tmp_path):
    name = "as_built/soft/run001.csv"
    moved = tmp_path / "data" / "as_built" / "soft" / "new [1].csv"
    moved.parent.mkdir(parents=True)
    shutil.copy(small[0] / "unseen" / name, moved)
    found = exported(
        small[0] / "out", "as_built/soft/new [1].csv", tmp_path, "--data", tmp_path / "data"
    )
    assert (found.about["fitted"], found.about["run"]) == ("no", "as_built/soft/new [1].csv")
    assert "/region90/selected" in found.messages


def test_a_log_that_has_changed_is_named(small, tmp_path):
    words = "as_built/soft/run001.csv", tmp_path, "--data", small[0] / "unseen"
    found = exported(small[0] / "out", *words)
    assert found.about["fitted"] == "changed"
    assert "SHA-256 hash is not that of the fitted log" in found.about["notes"]


def test_a_calibration_alone_is_exported_too(small, tmp_path):
    folder = small[0]
    words = ("--data", folder / "logs", "--out", tmp_path / "out", "--only", "calibration")
    assert invoke("identify", folder / "my.toml", *words, "--quiet").exit_code == 0
    found = exported(tmp_path / "out", "run003", tmp_path)
    selected = found.about["selected_model"]
    np.testing.assert_allclose(found.poses("selected"), found.poses(selected), atol=1e-12)
    outlines = found.messages["/region90/selected"]
    assert len(outlines) == len(found.messages["/pose/selected"])
    gap = points(outlines[-1][1])[:, :2] - found.poses("measured")[-1, :2]
    turned = np.unwrap(np.arctan2(gap[:, 1], gap[:, 0]))
    assert abs(turned[-1] - turned[0]) > np.pi  # the measured end lies inside
    (tmp_path / "out" / "robot.json").unlink()
    found = exported(tmp_path / "out", "run003", tmp_path)
    assert not {"/slip_ratio", "/floor/probability", "/pose/estimator"} & set(found.messages)
    assert "robot.json: missing" in found.about["notes"]


def test_a_run_over_several_floors_is_drawn_on_its_map(small, tmp_path):
    out, data = tmp_path / "out", tmp_path / "data"
    shutil.copytree(small[0] / "out", out)
    (data / "site").mkdir(parents=True)
    shutil.copy(small[0] / "logs" / RUN, data / "site" / "run.csv")
    more = '[[logs]]\nglob = "site/*.csv"\nformat = "demo"\nmap = "site.toml"\n'
    text = (out / "config.toml").read_text().replace("[parameters]", f"{more}\n[parameters]", 1)
    (out / "config.toml").write_text(text)
    about = json.loads((out / "run.json").read_text())
    about["config"]["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    (out / "run.json").write_text(json.dumps(about))
    words = ("--data", data)
    found = exported(out, "site/run.csv", tmp_path, *words)
    assert "site.toml: no such floor map; name it by --map" in found.about["notes"]
    corners = [(0.1, -1.0), (1.0, -1.0), (1.0, 1.0), (0.1, 1.0)]
    floor = from_polygons("soft", [("rug", corners)], (-1.0, -1.0, 1.0, 1.0))
    write_map(tmp_path / "site.toml", floor, {"soft": "#ffffff", "rug": "#206030"})
    found = exported(out, "site/run.csv", tmp_path, *words, "--map", tmp_path / "site.toml")
    assert {"nominal", "measured", "estimator"} == {
        topic.rpartition("/")[2] for topic in found.messages if topic.startswith("/pose/")
    }
    assert "over several floors" in found.about["notes"]
    ((_, drawn),) = found.messages["/floor_map"]
    place, colour = points(drawn), np.array(colours(drawn))
    assert len(place) == 200 * 200
    assert len(set(colour)) == 2
    rug = colour == colour[place[:, 0].argmax()]
    np.testing.assert_array_equal(rug, place[:, 0] > 0.1)
    assert place[:, 2].max() < 0
    assert "over several floors (soft, rug), not all of them identified" in found.about["notes"]
    write_map(tmp_path / "site.toml", uniform("soft", 0.5), {"soft": "#ffffff"})
    mapped = exported(out, "site/run.csv", tmp_path, *words, "--map", tmp_path / "site.toml")
    single = exported(small[0] / "out", RUN, tmp_path)
    for name in PATHS[:3]:
        np.testing.assert_allclose(mapped.poses(name), single.poses(name), atol=1e-6)
    error = mapped.poses("selected")[-1, :2] - single.poses("selected")[-1, :2]
    assert np.hypot(*error) < 0.02  # without the shared effects of neighbouring runs
    assert mapped.about["selected_model"] == single.about["selected_model"]
    # the start is that of the measured path, and the robot is lost no farther than wheels slip
    np.testing.assert_allclose(found.poses("estimator")[0], found.poses("measured")[0], atol=0.01)


# errors -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("run00", ("10 runs", "run.json", "expected one of as_built/soft/run000.csv")),
        ("run99", ("neither a run in", "nor a log in", "as_built/soft/run000.csv")),
        ("as_built", ("12 runs",)),
    ],
)
def test_an_unclear_run_is_2_and_lists_the_choices(small, tmp_path, name, words):
    done = invoke("export-run", small[0] / "out", name, "--out", tmp_path / "run.mcap")
    assert done.exit_code == 2
    for word in words:
        assert word in done.stderr
    assert not (tmp_path / "run.mcap").exists()


def test_logs_that_moved_are_2_and_the_option_is_named(small, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(small[0] / "out", out)
    about = json.loads((out / "run.json").read_text())
    about["data"]["folder"] = str(tmp_path / "gone")
    (out / "run.json").write_text(json.dumps(about))
    done = invoke("export-run", out, RUN, "--out", tmp_path / "run.mcap")
    assert (done.exit_code, "gone: no such folder" in done.stderr) == (2, True)
    assert "--data" in done.stderr
    done = invoke("export-run", out, RUN, "--out", tmp_path / "run.mcap", "--data", tmp_path)
    assert (done.exit_code, "run003.csv: no such log" in done.stderr) == (2, True)
    (out / "run.json").write_text("{}")
    done = invoke("export-run", out, RUN, "--out", tmp_path / "run.mcap")
    assert (done.exit_code, "run.json: schema: missing" in done.stderr) == (2, True)


def test_a_damaged_log_or_result_is_2_and_a_message(small, tmp_path):
    data = tmp_path / "data"
    shutil.copytree(small[0] / "logs", data)
    lines = (data / RUN).read_text().splitlines()
    lines[20] = lines[20].replace(",", ",x", 1)
    (data / RUN).write_text("\n".join(lines))
    words = ("--out", tmp_path / "run.mcap", "--quiet")
    done = invoke("export-run", small[0] / "out", RUN, "--data", data, *words)
    assert done.exit_code == 2
    assert "row 21" in done.stderr
    out = tmp_path / "out"
    shutil.copytree(small[0] / "out", out)
    (out / "fit.json").write_text((out / "fit.json").read_text().replace("0.", "1.", 1))
    done = invoke("export-run", out, RUN, *words)
    assert (done.exit_code, "damaged or edited" in done.stderr) == (2, True)


@pytest.mark.parametrize("package", ["mcap_protobuf", "foxglove_schemas_protobuf"])
def test_a_missing_package_is_2_and_the_command_is_told(small, tmp_path, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    done = invoke("export-run", small[0] / "out", RUN, "--out", tmp_path / "run.mcap")
    assert done.exit_code == 2
    assert f"an MCAP file needs the package {package}, which is not" in done.stderr
    assert "[mcap]'" in done.stderr
