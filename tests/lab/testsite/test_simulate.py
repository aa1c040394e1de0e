"""`slipid simulate`: files, seeds, interrupts, mistakes; and a camera with readable frames."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from slipid.app.config import parsed
from slipid.cli.common import executor_of
from slipid.cli.main import app
from slipid.data.floor_map import four_zones, read_map
from slipid.data.reading.presets import declared_layout, preset
from slipid.lab.testsite.config import all_filmed, can_identify, identify_config, plan
from slipid.lab.testsite.motors import MotorBuild, SpeedLoop
from slipid.lab.testsite.omni_build import OmniBuild
from slipid.lab.testsite.ordinary_build import OrdinaryBuild
from slipid.lab.testsite.sections import SimulationContent
from slipid.lab.testsite.simulate import SiteTask, _log_path, simulate, truth
from slipid.lab.testsite.site import Site, SiteCamera, SiteSensors
from slipid.lab.testsite.studio import MARKER, Studio, film
from slipid.lab.testsite.surfaces import SURFACES
from slipid.support.errors import DataError
from slipid.support.executor import InProcess
from slipid.support.progress import Reporter
from slipid.support.toml_file import checked
from tests.conftest import ROOT
from tests.helpers.floors import surface_at
from tests.helpers.nonsense import refuse_nonsense
from tests.helpers.one_log import read_log
from tests.helpers.shared import invoke

SMALL = """
seed = 3
formats = ["slipid", "robotino2022"]
[maps]
zones = { kind = "four_zones", surfaces = ["firm", "soft", "medium", "short"] }
[sensors]
gyro = true
[surfaces.soft]
friction = 0.7
[surfaces.snow]
friction = 0.3
rolling_m = 0.002
[[runs]]
kind = "headings"
surface = "snow"
load = "moved"
step_deg = 180
speeds_m_s = [0.2]
distance_m = 0.1
[[runs]]
kind = "rectangle"
map = "zones"
speed_m_s = 0.4
by = "camera"
"""


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "site.toml"
    path.write_text(SMALL)
    return path


def quietly(config, out, jobs=1):
    with Reporter(quiet=True) as report, executor_of(jobs) as executor:
        return simulate(plan(config, config.read_text()), out, executor, report)


def sums(folder):
    # what a kill leaves of a file that was being written begins with a dot, and nobody reads it
    files = sorted(p for p in folder.rglob("[!.]*") if p.is_file())
    return {p.relative_to(folder): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_a_folder_with_logs_of_other_origin_is_refused(config, tmp_path):
    (tmp_path / "logs").mkdir()
    with pytest.raises(DataError, match=r"logs: not of a simulation"):
        quietly(config, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["logs", "site.toml"]


@pytest.mark.slow
def test_the_same_seed_writes_the_same_bytes_with_any_number_of_processes(config, tmp_path):
    found = quietly(config, tmp_path / "one")
    assert found["driven"] == 3
    quietly(config, tmp_path / "two", jobs=2)
    one, two = sums(tmp_path / "one"), sums(tmp_path / "two")
    assert one == two
    names = {p.as_posix() for p in one}
    assert names == {
        "simulate.json",
        "robot.toml",
        "maps/zones.toml",
        "maps/zones.png",
        "truth/truth.json",
        *(f"logs/moved/snow/run00{k}.csv" for k in (0, 1)),
        *(f"truth/moved/snow/run00{k}.npz" for k in (0, 1)),
        *(f"robotino2022/wheel_load/snow/exp00{k}.csv" for k in (0, 1)),
        "logs/as_built/zones/run000.csv",
        "truth/as_built/zones/run000.npz",
        "robotino2022/two_surfaces/zones/exp000.csv",
    }
    # nothing is driven twice
    assert quietly(config, tmp_path / "one")["driven"] == 0
    # the truth says what lay under each wheel, and the log's poses are those of the truth
    with np.load(tmp_path / "one/truth/as_built/zones/run000.npz") as true:
        assert {b"firm", b"soft", b"medium", b"short"} == set(np.unique(true["surface"]))
        pose, at = true["pose"], true["time"]
    folder = tmp_path / "one/robotino2022"
    path = folder / "two_surfaces/zones/exp000.csv"
    log = read_log(path, preset("robotino2022"), root=folder, surface=None)
    x = np.interp(log.time - 0.056, at, pose[:, 0])
    seen = 1.117 * (log.pose[:, 0] + 1.7668435)
    assert np.median(np.abs(seen - x)) < 0.003
    floor = read_map(tmp_path / "one/maps/zones.toml")
    assert floor.surfaces == ("firm", "soft", "medium", "short")
    assert surface_at(floor, 0.8, 0.0) == "soft"


def children(pid):
    """Processes that another one started."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(path.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(path.parent.name))
    return found


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_a_killed_simulation_goes_on(config, tmp_path):
    config.write_text(SMALL.replace("step_deg = 180", "step_deg = 30"))
    code = "from slipid.cli.main import main; main()"
    command = [sys.executable, "-c", code, "simulate", str(config), "--out", str(tmp_path / "out")]
    run = subprocess.Popen([*command, "--jobs", "2", "--quiet"], env=dict(os.environ), cwd=ROOT)
    try:
        until = time.monotonic() + 120
        while len(list((tmp_path / "out").rglob("run*.npz"))) < 3 and time.monotonic() < until:
            time.sleep(0.02)
        workers = children(run.pid)
        run.send_signal(signal.SIGKILL)
    finally:
        run.wait()
    assert len(workers) >= 2
    until = time.monotonic() + 20
    while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < until:
        time.sleep(0.1)  # those that drove notice that nobody waits for them
    assert not any(Path(f"/proc/{pid}").exists() for pid in workers)
    done = len(list((tmp_path / "out").rglob("run*.npz")))
    assert 3 <= done < 13
    assert quietly(config, tmp_path / "out")["driven"] == 13 - done
    quietly(config, tmp_path / "whole")
    assert sums(tmp_path / "out") == sums(tmp_path / "whole")


def test_another_config_does_not_mix_with_what_is_there(config, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "simulate.json").write_text('{"config_hash": "other"}')
    with pytest.raises(DataError, match="contains runs with another config"):
        quietly(config, out)


def test_known_surfaces_are_changed_and_others_are_new(config):
    found = plan(config, config.read_text())
    assert found.site.surfaces["soft"].friction == 0.7
    assert found.site.surfaces["soft"].rolling_m == SURFACES["soft"].rolling_m
    assert found.site.surfaces["snow"].friction == 0.3
    assert [name for name, _ in found.runs] == [
        "moved/snow/run000",
        "moved/snow/run001",
        "as_built/zones/run000",
    ]
    assert found.runs[0][1].start[2] != found.runs[1][1].start[2]


def test_a_map_is_read_from_its_file_beside_the_config(tmp_path):
    (tmp_path / "floor.toml").write_text(
        'schema = "slipid.map/1"\nbase = "firm"\nextent_m = [-1.0, -1.0, 1.0, 1.0]\n'
        '[[patch]]\nsurface = "soft"\npolygon = [[0.0, 0.0], [0.5, 0.0], [0.5, 0.5]]\n'
    )
    text = SMALL.replace('kind = "four_zones", surfaces = ["firm", "soft", "medium", "short"]', "x")
    text = text.replace("{ x }", '{ kind = "file", file = "floor.toml" }')
    found = plan(tmp_path / "site.toml", text)
    assert surface_at(found.maps["zones"], 0.4, 0.1) == "soft"
    other = (tmp_path / "floor.toml").read_text().replace("0.5, 0.5", "0.5, 0.9")
    (tmp_path / "floor.toml").write_text(other)
    assert plan(tmp_path / "site.toml", text).hash != found.hash


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("testsite*.toml")))
def test_the_configs_that_ship_are_good(path):
    assert plan(path, path.read_text()).runs


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (('surface = "snow"', 'surface = "snov"'), r"runs\[1\].surface: 'snov'; expected one of"),
        (('load = "moved"', 'load = "far"'), r"runs\[1\].load: 'far'; expected one of as_built"),
        (('map = "zones"', 'map = "zone"'), r"runs\[2\].map: 'zone'; expected one of zones"),
        (('"medium", "short"', '"medium", "lawn"'), "maps.zones: 'lawn'; expected one of"),
        (("friction = 0.3", "friction = -1"), "surfaces.snow.friction: -1; expected"),
        (("rolling_m", "roling_m"), "no such key, did you mean rolling_m"),
        (('kind = "headings"', ""), r"runs\[1\].kind: missing; expected one of headings"),
        (("seed = 3", 'seed = 3\nvideo = ["*/lawn/*"]'), "no run matches '.*lawn/"),
        (('"four_zones", surfaces', '"file", file'), "maps.zones.file"),
        (("seed = 3", "seed = -3"), "seed: -3; expected"),
        (("[surfaces.snow]", '[surfaces."my snow"]'), "surfaces.*my snow.*expected"),
        (
            ("[maps]", '[maps]\nsoft = { kind = "patchwork", surfaces = ["firm"] }'),
            "maps.soft: also the name of a surface",
        ),
        (("friction = 0.7", 'colour = "#8f9194"'), "maps.zones: two surfaces have the same colour"),
        (
            ("gyro = true", "current_is_signed = true"),
            "formats: robotino2022 is only for three omni wheels",
        ),
        (
            ("[maps]", '[robot]\ncentres_m = { "../x" = [0, 0] }\n[maps]'),
            "'../x' cannot be the name",
        ),
        (("[maps]", "[robot]\ncentres_m = { as_built = [9.0, 0] }\n[maps]"), "centre of mass"),
        (
            ("[maps]", "[robot]\nwheel_azimuths_deg = [60, 60, 60]\n[maps]"),
            "expected angles all around",
        ),
        (("step_deg = 180", "step_deg = 1e-9"), "step_deg: 1e-09"),
        (("distance_m = 0.1", "distance_m = inf"), "distance_m: inf"),
        (
            ("rolling_m = 0.002", "body_drag_n = 1e9"),
            r"body_drag_n: 1000000000\.0; expected a number from 0 to 1000 N",
        ),
        (
            (
                'kind = "four_zones", surfaces = ["firm", "soft", "medium", "short"]',
                'kind = "patchwork", surfaces = ["firm"], half_m = 0.1',
            ),
            "half_m: 0.1",
        ),
        (
            (
                'kind = "four_zones", surfaces = ["firm", "soft", "medium", "short"]',
                'kind = "patchwork", surfaces = ["firm"], half_m = 20.0, patch_m = 0.01',
            ),
            "maps.zones: .*cells; expected|maps.zones: .*patches; expected",
        ),
    ],
)
def test_mistakes_are_named_with_their_key(tmp_path, change, match):
    text = SMALL.replace(*change)
    assert text != SMALL
    with pytest.raises(DataError, match=match) as error:
        plan(tmp_path / "site.toml", text)
    assert str(error.value).startswith(str(tmp_path / "site.toml"))


def test_every_number_of_the_site_has_bounds(tmp_path):
    runs = [
        {"kind": "headings", "surface": "a", "step_deg": 9, "first_deg": 1, "distance_m": 1},
        {"kind": "curves", "surface": "a", "count": 1, "speeds_m_s": [0.1], "distance_m": 1},
        {"kind": "paper_grid", "surface": "a", "seconds": 1},
        {"kind": "arcs", "surface": "a", "curvatures_1_m": [0.5], "speeds_m_s": [-0.1]},
        {"kind": "spins", "surface": "a", "rates_deg_s": [-40.0], "angle_deg": 9},
        {"kind": "paths", "surface": "a", "seed": 1, "count": 1, "legs": 1, "turn_deg_s": 9},
        {"kind": "wander", "map": "p", "count": 1, "points": 1},
        {"kind": "rectangle", "map": "p", "repeats": 1, "speed_m_s": 0.1},
    ]
    parts = {"motor": MotorBuild(), "speed_loop": SpeedLoop(), "sensors": SiteSensors()}
    parts |= {"robot": OmniBuild(), "camera": SiteCamera()}
    content = {key: json.loads(json.dumps(asdict(part))) for key, part in parts.items()}
    content["surfaces"] = {"a": asdict(SURFACES["ribbed"])}
    content["maps"] = {"p": {"kind": "patchwork", "surfaces": ["a"], "seed": 1, "half_m": 1.0}}
    content |= {"seed": 0, "heading_jitter_deg": 5, "command_delay_s": 0.1, "runs": runs}

    def read(mapping):
        return checked("site.toml", mapping, SimulationContent)

    assert refuse_nonsense(content, read, set()) > 90
    for drive in ({"wheelbase_m": 0.3}, {"drive": "differential", "castor_m": [-0.2, 0.0]}):
        robot = asdict(OrdinaryBuild(**{"centres_m": {"b": (-0.01, 0.0)}, **drive}))
        robot = {key: one for key, one in robot.items() if one is not None}
        one = {"robot": json.loads(json.dumps(robot)), "runs": runs[:1]}
        assert refuse_nonsense(one, read, {"wheelbase_m", "castor_m"}) > 15


def test_a_jitter_of_minus_0_is_0(tmp_path):
    found = [
        plan(tmp_path / "x", f"heading_jitter_deg = {zero}\n{SMALL}") for zero in ("-0.0", "0")
    ]
    assert found[0].runs[0][1].start == found[1].runs[0][1].start


def test_a_bad_config_ends_with_2_and_a_line(tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text(SMALL.replace('load = "moved"', 'load = "far"'))
    result = CliRunner().invoke(app, ["simulate", str(bad), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "runs[1].load: 'far'; expected one of as_built, moved" in result.stderr
    assert not (tmp_path / "out").exists()


def test_the_same_hash_means_the_same_runs(tmp_path):
    first = plan(tmp_path / "x", SMALL).hash
    assert plan(tmp_path / "x", "# a word\n" + SMALL).hash == first
    assert plan(tmp_path / "x", 'video = ["*zones*"]\n' + SMALL).hash == first  # later, too
    for change in (("seed = 3", "seed = 4"), ("0.7", "0.71"), ('"firm", "soft"', '"soft", "firm"')):
        assert plan(tmp_path / "x", SMALL.replace(*change)).hash != first


def test_loads_on_one_map_do_not_overwrite_each_other(tmp_path):
    text = SMALL + '[[runs]]\nkind = "rectangle"\nmap = "zones"\nload = "moved"\n'
    made = plan(tmp_path / "x", text)
    jobs = [SiteTask(name, run, made.site, 0, (), tmp_path) for name, run in made.runs]
    for form in ("slipid", "robotino2022"):
        places = [_log_path(form, job) for job in jobs]
        assert len(set(places)) == len(places)


def test_an_unstable_simulation_is_no_log(tmp_path, capfd):
    text = (
        SMALL.replace("rolling_m = 0.002", "shear_n_m = 1e5")
        .replace("gyro = true", "gyro = true\n[robot]\nmount_n_m = 1e9\nroller_mass_kg = 1e-4")
        .replace("friction = 0.3", "friction = 0.3\nsoftness_m = 1e-9")
    )
    config = tmp_path / "x.toml"
    config.write_text(text.replace("shear_n_m = 1e5", "shear_n_m = 1e12"))
    with pytest.raises(DataError, match="moved/snow/run000: the simulation became unstable"):
        quietly(config, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("run*"))
    assert not (Path.cwd() / "MUJOCO_LOG.TXT").exists()


def test_only_runs_that_a_fit_can_use_get_a_config_for_it(tmp_path):
    config = tmp_path / "x.toml"
    start = SMALL.index("[[runs]]")
    config.write_text(SMALL[:start] + SMALL[SMALL.index("[[runs]]", start + 1) :])
    assert not can_identify(plan(config, config.read_text()))
    assert can_identify(plan(config, SMALL))


MIXED = """
[maps]
site = { kind = "patchwork", surfaces = ["firm", "soft"], half_m = 0.5 }
other = { kind = "patchwork", surfaces = ["firm", "medium"], half_m = 0.5 }
[[runs]]
kind = "headings"
surface = "firm"
[[runs]]
kind = "headings"
surface = "soft"
[[runs]]
kind = "wander"
map = "site"
count = 1
[[runs]]
kind = "wander"
map = "other"
count = 1
"""


def test_runs_on_a_map_of_floors_that_were_driven_are_fitted_with_it(tmp_path):
    found = parsed(tmp_path / "robot.toml", identify_config(plan(tmp_path / "x", MIXED))).content
    said = [(logs.glob, logs.map) for logs in found.logs]
    assert said == [
        ("as_built/firm/run*[0-9].csv", None),
        ("as_built/soft/run*[0-9].csv", None),
        ("as_built/site/run*[0-9].csv", "maps/site.toml"),
    ]
    # a load that no run on one floor had
    text = MIXED.replace('map = "site"', 'map = "site"\nload = "moved"')
    found = parsed(tmp_path / "robot.toml", identify_config(plan(tmp_path / "x", text))).content
    assert len(found.logs) == 2


def test_where_all_runs_are_filmed_a_config_takes_the_poses_of_their_videos(tmp_path):
    filmed = plan(tmp_path / "x", f'video = ["*"]\n{MIXED}')
    assert all_filmed(filmed)
    assert not all_filmed(plan(tmp_path / "x", f'video = ["*/firm/*"]\n{MIXED}'))
    # a map with a floor that no run keeps to is not read by the fit either
    assert all_filmed(
        plan(tmp_path / "x", f'video = ["*/firm/*", "*/soft/*", "*/site/*"]\n{MIXED}')
    )
    found = parsed(tmp_path / "r.toml", identify_config(filmed, by_video=True)).content
    known = declared_layout(found.layouts["testsite"], "testsite")
    assert not [name for name in known.channels if name.startswith("pose")]
    assert known.beside["{stem}.poses.csv"] == preset("tracked")
    assert found.parameters["camera.scale"].prior.mean == pytest.approx(1.0, abs=0.01)
    plain = parsed(tmp_path / "r.toml", identify_config(filmed)).content
    assert "beside" not in plain.layouts["testsite"]
    assert plain.parameters["camera.scale"].prior.mean == pytest.approx(1.117, abs=0.01)


@pytest.mark.slow
def test_a_camera_that_is_started_early_films_a_robot_that_stands(tmp_path):
    text = """
video = ["*"]
[camera]
width_px = 320
height_px = 180
focal_px = 200
frame_s = 0.2
early_s = 0.5
noise = 0
flicker = 0
[[runs]]
kind = "headings"
surface = "firm"
step_deg = 360
speeds_m_s = [0.2]
distance_m = 0.1
"""
    path = tmp_path / "x.toml"
    path.write_text(text)
    try:
        with Reporter(quiet=True) as report:
            simulate(plan(path, text), tmp_path, InProcess(), report)
    except DataError as error:
        pytest.skip(f"frames cannot be drawn here: {error}")
    times = np.loadtxt(tmp_path / "video/as_built/firm/run000.csv", delimiter=",", skiprows=1)
    assert times[0].tolist() == [0.0, -0.5]
    video = cv2.VideoCapture(str(tmp_path / "video/as_built/firm/run000.avi"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(times)
    first, second = (video.read()[1].astype(float) for _ in range(2))
    *_, last = (video.read()[1].astype(float) for _ in range(len(times) - 2))
    assert np.abs(second - first).max() == 0.0
    assert np.abs(last - first).max() > 20.0
    assert (tmp_path / "robot_video.toml").is_file()


def test_the_truth_has_the_names_of_a_fit():
    found = truth(Site())
    share = found["robot.load_share@as_built"]["value"]
    assert sum(share) == pytest.approx(1.0)
    # a wheel carries more where the centre of mass is nearer
    assert share[1] > share[0] > share[2]
    assert found["motor.resistance"] == {"value": 5.5, "unit": "ohm"}


# the camera: needs OpenGL, which a machine without EGL does not have

HALF = SiteCamera(width_px=960, height_px=540, focal_px=600.0)


@pytest.fixture(scope="module")
def studio():
    floor = four_zones(["firm", "medium", "soft", "short"])
    try:
        made = Studio(Site(), "as_built", floor, HALF)
    except DataError as error:
        pytest.skip(str(error))
    yield made
    made.close()


def pixels(camera, points):
    """Pixels at which points of the world are seen."""
    turn, _ = cv2.Rodrigues(camera.rotation)
    shift = -camera.rotation @ camera.place
    seen, _ = cv2.projectPoints(points, turn, shift, camera.matrix, np.array(camera.distortion))
    return seen[:, 0]


def corners(pose, robot, camera):
    """Where the marker's corners should be seen, in ArUco's order; its top edge is ahead."""
    yaw, half = pose[2] + np.radians(robot.marker_yaw_deg), 0.5 * robot.marker_size_m
    c, s = np.cos(yaw), np.sin(yaw)
    flat = half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) @ np.array([[c, s], [-s, c]])
    return pixels(camera, np.c_[flat + pose[:2], np.full(4, robot.marker_height_m)])


@pytest.mark.slow
def test_the_marker_is_detected_where_the_camera_projects_it(studio):
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.ArucoDetector(book)
    for k, pose in enumerate(([0.3, 0.2, 0.4], [-0.9, -0.4, 2.0], [0.0, 0.0, -1.0])):
        pose = np.array(pose)
        image = studio.exposed(float(k), lambda t, p=pose: (p, np.zeros(3)))
        assert image.shape == (540, 960, 3)
        found, numbers, _ = detector.detectMarkers(image)
        assert numbers is not None
        assert numbers.ravel().tolist() == [MARKER]
        np.testing.assert_allclose(found[0][0], corners(pose, OmniBuild(), HALF), atol=1.2)


@pytest.mark.slow
def test_the_floor_has_its_colours_where_its_patches_are(studio):
    image = studio.frame(np.array([0.45, -0.2, 0.0]), np.zeros(3)).astype(float)
    for place, name in (((-0.3, 0.3), "firm"), ((0.9, 0.3), "medium"), ((0.0, -0.6), "short")):
        x, y = pixels(HALF, np.array([[*place, 0.0]]))[0].round().astype(int)
        seen = image[y - 8 : y + 8, x - 8 : x + 8].mean(axis=(0, 1))[::-1]
        colour = SURFACES[name].colour
        wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], float)
        np.testing.assert_allclose(seen / seen.sum(), wanted / wanted.sum(), atol=0.03)


@pytest.mark.slow
def test_light_changes_and_motion_smears(studio):
    def still(t):
        return np.array([0.3, 0.2, 0.4]), np.zeros(3)

    def moving(t):
        return np.array([0.3 + 1.0 * t, 0.2, 0.4]), np.zeros(3)

    bright = [studio.exposed(t, still).mean() for t in np.arange(0.0, 8.0, 1.0)]
    assert np.ptp(bright) > 0.03 * np.mean(bright)
    x, y = corners(still(0.0)[0], OmniBuild(), HALF).mean(axis=0).round().astype(int)
    sharp, smeared = (
        np.diff(studio.exposed(0.0, where)[y - 30 : y + 30, x - 30 : x + 30, 1].astype(float))
        for where in (still, moving)
    )
    assert np.sort(np.abs(smeared).ravel())[-50] < 0.8 * np.sort(np.abs(sharp).ravel())[-50]


def test_a_video_has_all_its_frames(studio, tmp_path):
    time_s = np.arange(0.0, 0.3, 0.01)
    pose = np.stack([0.3 + 0.2 * time_s, 0 * time_s, 0 * time_s], axis=1)
    frames = np.arange(0.0, 0.25, 0.05)
    true = {"time": time_s, "pose": pose, "wheel_angle": np.zeros((len(time_s), 3))}
    film(studio, true, frames, tmp_path / "run.avi")
    video = cv2.VideoCapture(str(tmp_path / "run.avi"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(frames)
    assert video.read()[1].shape == (540, 960, 3)
    assert [p.name for p in tmp_path.iterdir()] == ["run.avi"]


def test_the_config_of_a_robot_is_named_in_a_sentence(tmp_path):
    ended = invoke("simulate", ROOT / "configs" / "robotino2022.toml", "--out", tmp_path / "out")
    assert ended.exit_code == 2
    assert "the config of a robot and its logs; expected that of a test site" in ended.stderr
    assert len(ended.stderr) < 500
