"""robot.json: every number survives, and whatever is wrong with a file is one clear sentence."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from dataclasses import replace
from importlib import resources
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest

from slipid.deploy.deploy import given_numbers
from slipid.deploy.robot_record import robot_record
from slipid.model.geometry import differential, omni
from slipid.model.robot import Validity, build
from slipid.robot.deployed import DeployedRobot, posterior_robots
from slipid.robot.interface import Settings
from slipid.robot.limits import Limits
from slipid.robot.record import EffectRecord, Setting
from slipid.support.errors import DataError
from slipid.support.files import checksum
from tests.helpers.known_robot import deploy_known

SCHEMA = json.loads(resources.files("slipid.robot").joinpath("robot.schema.json").read_text())
SEEN = Validity(
    3, ("as_built",), (0.0, 8.0), (0.0, 0.4), (0.0, 0.3), (0.0, 1.0), (0.0,), (), (), 1.1
)
ONE = (((0.01, -0.02, 1 / 3), (0.0, 0.1 + 0.2, 0.0)), ((0.0, 0.0, 0.0), (0.001, 0.0, -0.1)))
"""Effects of a floor at two speeds and in two directions."""
LEFT = (((0.01, 0.02, 0.03), (0.03, 0.02, 0.01)), ((0.01, 0.01, 0.01), (0.02, 0.02, 0.0)))
TOLD = EffectRecord((0.1, 0.3), (ONE, ONE[::-1]), (LEFT, LEFT[::-1]))


@pytest.fixture(scope="module")
def robot() -> DeployedRobot:
    """Two floors, two load set-ups, odd numbers and draws."""
    made = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["firm", "soft"], ["own", "moved"])
    share = jnp.asarray([[0.29, 0.44, 0.27], [0.1, 0.2, 0.7]])
    friction = jnp.asarray([1 / 3, 0.1 + 0.2])
    biases = jnp.asarray([[0.1, -0.3, 0.2], [0.0, 1 / 3, -1 / 3]])
    made = eqx.tree_at(
        lambda r: (
            r.body.load_share,
            r.body.mass_ratio,
            r.surfaces.friction,
            r.surfaces.drag_exponent,
            r.surfaces.knee_width,
            r.surfaces.load_bias,
        ),
        made,
        (
            share,
            jnp.asarray([1.0, 1.3]),
            friction,
            jnp.asarray([1.0, 1.6]),
            jnp.asarray([0.3, 1.1]),
            biases,
        ),
    )
    several = jax.tree.map(lambda x: jnp.broadcast_to(x, (5, *x.shape)), made)
    noise = np.random.default_rng(0).normal(size=(5, 2))
    shaken = friction * jnp.exp(0.1 * jnp.asarray(noise))
    several = eqx.tree_at(
        lambda r: (r.surfaces.friction, r.surfaces.load_bias),
        several,
        (shaken, biases * jnp.arange(5)[:, None, None]),
    )
    numbers = given_numbers(made)
    share_path = "robot.load_share@own"
    pairs = tuple((x - 0.01, x + 0.01) for x in share[0].tolist())
    known = {"std": (0.01, 0.01, 0.01), "interval90": pairs, "verdict": "identified"}
    numbers[share_path] = replace(numbers[share_path], **known)
    std = {"process.firm.along": 0.003, "session.soft.yaw": 0.02}
    record = robot_record(
        made, numbers, std, several, 8.1, (0.01, -0.02), {"firm": SEEN}, {"moved": TOLD}
    )
    record = replace(record, messages=("say \u00e9 aloud",), versions={"jax": "0.1"})
    return DeployedRobot.of(record, "moved")


@pytest.fixture
def path(robot, tmp_path) -> Path:
    robot.save(tmp_path / "robot.json")
    return tmp_path / "robot.json"


def same(a: DeployedRobot, b: DeployedRobot) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y, strict=True)


@pytest.mark.slow
def test_every_number_survives_to_the_last_bit(robot, path):
    again = DeployedRobot.load(path, load="moved")
    assert again.record == robot.record
    assert hash(again.record) == hash(robot.record)
    same(again, robot)
    first = DeployedRobot.load(path)
    assert first.load_setup == "own"
    np.testing.assert_array_equal(first.rest, [0.29, 0.44, 0.27])
    assert float(again.mass) == 1.3 * float(first.mass)
    assert float(again.floors.friction[1]) == 0.1 + 0.2
    np.testing.assert_array_equal(again.floors.load_bias, [[0.1, -0.3, 0.2], [0.0, 1 / 3, -1 / 3]])
    np.testing.assert_array_equal(again.floors.drag_exponent, [1.0, 1.6])
    np.testing.assert_array_equal(again.floors.knee_width, [0.3, 1.1])
    np.testing.assert_array_equal(again.effect_table.table[..., :3], TOLD.mean)
    np.testing.assert_array_equal(first.effect_table.table, [[[[0, 0, 0, 1, 1, 1]]]] * 2)
    text = path.read_bytes()
    first.save(path)
    assert path.read_bytes() == text
    assert len(text) < 21_000


def test_draws_are_robots_with_other_numbers(robot):
    several = posterior_robots(robot, (4, 0))
    rows = robot.record.draws["surface.soft.friction"]
    np.testing.assert_array_equal(several.floors.friction[:, 1], [rows[4], rows[0]])
    biases = np.asarray(robot.floors.load_bias)
    np.testing.assert_array_equal(several.floors.load_bias, [4 * biases, 0 * biases])
    paths = {f"surface.{x}.{y}" for x in ("firm", "soft") for y in ("friction", "load_bias")}
    assert set(robot.record.draws) == paths
    spread = np.asarray(robot.record.loads[1].spread)
    assert (spread[:, 0] > 0).all()
    effect = np.asarray([floor.effect for floor in robot.record.floors])
    np.testing.assert_allclose(robot.effect, np.sqrt(effect**2 + spread**2), rtol=1e-12)
    np.testing.assert_array_equal(several.effect[0], effect)


def test_a_robot_whose_arrays_were_changed_is_not_saved(robot, tmp_path):
    changed = eqx.tree_at(lambda r: r.mass, robot, robot.mass + 1)
    with pytest.raises(
        ValueError, match="arrays of this robot were changed and differ from its record"
    ):
        changed.save(tmp_path / "robot.json")
    assert not any(tmp_path.iterdir())


def test_what_is_known_of_the_floors_is_saved_with_them(robot, tmp_path):
    only = robot.on("soft")
    only.save(tmp_path / "soft.json")
    same(DeployedRobot.load(tmp_path / "soft.json", "moved"), only)
    np.testing.assert_array_equal(only.effect_table.table[0, ..., :3], ONE[::-1])


def test_floors_that_nobody_drove_on_are_saved_with_the_others(robot, tmp_path):
    wider = robot.with_unseen()
    wider.save(tmp_path / "wider.json")
    again = DeployedRobot.load(tmp_path / "wider.json", "moved")
    same(again, wider)
    assert again.record == wider.record
    assert again.with_unseen().record == wider.record
    jsonschema.validate(json.loads((tmp_path / "wider.json").read_text()), SCHEMA)
    same(wider.on(*robot.labels), robot)


@pytest.mark.slow
def test_the_schema_describes_what_is_written(path, robot):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.validate(json.loads(path.read_text()), SCHEMA)
    deploy_known(build(omni([0.0, 120.0, 240.0], 0.1, 0.03), ["a"])).save(path)
    jsonschema.validate(json.loads(path.read_text()), SCHEMA)


# what is refused -----------------------------------------------------------------------------


def write(path: Path, content: dict) -> None:
    """Any content, with hashes that are right."""
    content.pop("checksum", None)
    if "numbers" in content:
        fixed = {"versions": {}, "messages": []}
        numbers = {k: v for k, v in content.items() if k not in ("schema", "units", "numbers")}
        content["numbers"] = checksum(numbers | fixed)
    path.write_text(json.dumps(content | {"checksum": checksum(content)}))


def rewritten(path: Path, change) -> None:
    """The file after a change of its content, with hashes that are right."""
    content = json.loads(path.read_text())
    change(content)
    write(path, content)


def refused(path: Path) -> str:
    with pytest.raises(DataError) as caught:
        DeployedRobot.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def test_what_is_no_robot_is_refused(tmp_path):
    path = tmp_path / "robot.json"
    assert "No such file" in refused(path)
    assert "expected a robot.json that `slipid identify` wrote" in refused(path)
    assert "a folder; expected a robot.json" in refused(tmp_path)
    for text in ("", "{", '{"a": NaN}', '{"a": 1, "a": 2}', "[" * 100_000, '{"a": 1e}'):
        path.write_text(text)
        assert "not valid JSON" in refused(path)
    path.write_bytes(b"\xff\xfe")
    assert "not valid JSON" in refused(path)
    for text in (
        "{}",
        "3",
        '{"schema": "slipid.fit/1"}',
        '{"schema": 7}',
        '{"schema": "slipid.robot/x"}',
    ):
        path.write_text(text)
        assert "not a robot of slipid" in refused(path)


def test_a_newer_file_asks_for_an_update(path):
    rewritten(path, lambda c: c.update(schema="slipid.robot/99", more=3))
    message = refused(path)
    assert "written by a newer slipid as slipid.robot/99" in message
    assert "update slipid" in message


def test_an_older_file_whose_law_was_another_is_to_be_written_anew(path):
    """Forces saturated as tanh, which is no shape of a knee."""
    rewritten(path, lambda c: c.update(schema="slipid.robot/8"))
    message = refused(path)
    assert "written by an older slipid as slipid.robot/8" in message
    assert "write it again with `slipid identify`" in message


def test_limits_without_logs_follow_from_the_robots_own_wheels():
    two = build(differential(0.2, 0.1, 10.0), ["a"])
    record = robot_record(
        two, given_numbers(two), {}, jax.tree.map(lambda x: x[None], two), 30.0, (0.0, 0.0), {}
    )
    robot = DeployedRobot.of(record)
    limits = Limits.of(robot)
    assert limits.wheel_speed == pytest.approx(36.0)
    assert limits.speed == pytest.approx(3.6)
    assert limits.yaw_rate == 2.0
    # at its limits, the wheel that a motor turns against the largest current needs this voltage
    motor, amps = two.motor, record.loads[0].highest_current
    volt = float(motor.back_emf) * 10.0 * 36.0 + float(motor.resistance) * amps
    assert limits.voltage == pytest.approx(volt)
    assert record.limits.wheel_speed.provenance == "logs"
    assert record.limits.acceleration.provenance == "assumed"
    slow = robot_record(
        two, given_numbers(two), {}, jax.tree.map(lambda x: x[None], two), 3.0, (0.0, 0.0), {}
    )
    assert slow.limits.yaw_rate.value == pytest.approx(3.6 * 0.1 / 0.2)


def test_settings_of_an_estimator_are_those_of_the_robots_sensors(robot):
    sensors = replace(robot.record.sensors, gyro_std=Setting(0.02, "logs"), stale_s=Setting(1.5))
    settings = Settings.of(DeployedRobot.of(replace(robot.record, sensors=sensors)))
    assert (settings.gyro_std, settings.stale_s, settings.ammeter_std_a) == (0.02, 1.5, 0.07)


def test_a_changed_digit_is_refused(path):
    text = path.read_text()
    path.write_text(text.replace("0.003", "0.004", 1))
    assert "does not match its checksum" in refused(path)
    assert "write it again with `slipid identify`" in refused(path)
    path.write_text(text.replace('"voltage": false', '"voltage": true', 1))
    assert "does not match its checksum" in refused(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c.pop("loads"), "loads is missing"),
        (lambda c: c.pop("checksum"), "checksum"),
        (lambda c: c["parameters"].pop("motor.resistance"), "['motor.resistance'] is missing"),
        (
            lambda c: c["parameters"]["robot.mass"].pop("std"),
            "parameters['robot.mass'].std is miss",
        ),
        (lambda c: c["floors"][0].pop("effect"), "floors[0].effect is missing"),
        (lambda c: c.update(more=1), "more: no such field"),
        (lambda c: c["sensors"].update(gyro=1), "sensors.gyro: 1; expected true or false"),
        (lambda c: c["limits"]["speed"].update(value=0), "limits.speed.value: 0.0; expected a pos"),
        (lambda c: c["sensors"].pop("stale_s"), "sensors.stale_s is missing"),
        (
            lambda c: c["actuators"].update(lag_s={"value": -1, "provenance": "logs"}),
            "actuators.lag_s.value: -1.0; expected 0 or more",
        ),
        (
            lambda c: c["limits"]["voltage"].update(provenance="guess"),
            "limits.voltage.provenance: 'guess'; expected 'config' or 'logs' or 'assumed'",
        ),
        (lambda c: c.update(alike=True), "alike: True; expected a number"),
        (lambda c: c.update(alike=10**400), "alike: a whole number of 1329 bits"),
        (lambda c: c.update(source="guess"), "source: 'guess'; expected 'laplace' or"),
        (
            lambda c: c["floors"][0].update(process=[1.0]),
            "floors[0].process: 1 entries; expected 3",
        ),
        (lambda c: c["loads"][0].update(spread=[]), "loads, own: spread: 0 entries; expected 2"),
        (lambda c: c["loads"][1].pop("told"), "loads[1].told is missing"),
        (
            lambda c: c["loads"][1]["told"].update(speeds=[0.3, 0.1]),
            "loads, moved: told.speeds: [0.3, 0.1]; expected positive speeds in rising order",
        ),
        (lambda c: c["loads"][1]["told"]["mean"].pop(), "told.mean: 1 entries; expected 2"),
        (
            lambda c: c["loads"][1]["told"]["left"][0].pop(),
            "told.left, rows of a floor: 1 entries; expected 2",
        ),
        (
            lambda c: c["loads"][1]["told"]["left"][1][0].pop(),
            "told.left, directions of a speed: 1 entries; expected 2",
        ),
        (
            lambda c: c["loads"][1]["told"]["left"][0][0][0].__setitem__(2, -1),
            "told.left: a std is below 0",
        ),
        (
            lambda c: c["wheels"].update(drive_angle=[0.0]),
            "wheels.drive_angle: 1 entries; expected 3",
        ),
        (lambda c: c["wheels"].update(roller_angle=[0.0] * 3), "the wheel cannot drive"),
        (lambda c: c["wheels"].update(drive_of=[0, 0, 2]), "counted from 0 without a gap"),
        (lambda c: c["wheels"].update(drive_of=[0, 0]), "expected one for each of the 3 wheels"),
        (lambda c: c["wheels"].update(drive_of=[0, 1, 0.5]), "drive_of"),
        (lambda c: c["parameters"]["robot.mass"].update(value=-1), "expected inside (0, inf)"),
        (lambda c: c["parameters"]["robot.mass"].update(value=[1, 2]), "expected one number"),
        (lambda c: c["parameters"]["robot.mass"].update(unit="g"), "unit: 'g'; expected 'kg'"),
        (
            lambda c: c["parameters"]["robot.load_share@own"].update(value=[1, 1, 1]),
            "that sum to 1",
        ),
        (
            lambda c: c["parameters"]["robot.load_share@own"].update(std=1),
            "expected a list of 3 numbers",
        ),
        (lambda c: c["parameters"].pop("surface.soft.drag_exponent"), "drag_exponent'] is missing"),
        (
            lambda c: c["parameters"]["surface.soft.load_bias"].update(value=[0.1, 0.1, 0.1]),
            "expected numbers that sum to 0",
        ),
        (
            lambda c: c["parameters"]["surface.soft.load_bias"].update(value=0.0),
            "['surface.soft.load_bias'].value: 1 elements; expected a list of 3 numbers",
        ),
        (
            lambda c: c["draws"]["surface.soft.load_bias"].__setitem__(1, [0.1, 0.1, 0.1]),
            "draws['surface.soft.load_bias'][1] = ",
        ),
        (
            lambda c: c["draws"]["surface.soft.friction"].pop(),
            "draws: parameters have [4, 5] draws; expected the same number",
        ),
        (
            lambda c: c["draws"]["surface.soft.friction"].__setitem__(0, 0),
            "draws['surface.soft.frict",
        ),
        (lambda c: c["draws"].update(mass=[1]), "'mass' is not a parameter"),
        (
            lambda c: c["units"].update(alike="m"),
            "the units in this file differ from the units of slipid.robot/10",
        ),
        (
            lambda c: c.update(loads=c["loads"][:1] * 2),
            "expected at least one name, and each name only once",
        ),
        (
            lambda c: c.update(floors=[]),
            "floors []; expected at least one name, and each name only once",
        ),
    ],
)
def test_missing_and_wrong_fields_are_named(path, change, said):
    if "checksum" in said:
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))
    else:
        rewritten(path, change)
    found = refused(path)
    assert said in found
    assert "write it again with `slipid identify`" in found


def test_another_load_set_up_is_refused_with_those_there_are(path):
    with pytest.raises(DataError, match="no load set-up 'far'; identified: own, moved"):
        DeployedRobot.load(path, load="far")


# anything at all -----------------------------------------------------------------------------


def loads(path: Path) -> bool:
    """Whether a damaged file gives a robot; anything but that and a `DataError` is raised."""
    try:
        return isinstance(DeployedRobot.load(path), DeployedRobot)
    except DataError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017 (both ends are right)
        return False


@pytest.mark.slow
def test_damaged_bytes_give_a_robot_or_a_sentence(path):
    rng, good = random.Random(0), path.read_bytes()
    survived = 0
    for _ in range(300):
        data = bytearray(good)
        for _ in range(rng.choice([1, 1, 2, 8])):
            at = rng.randrange(len(data))
            kind = rng.choice(["flip", "drop", "insert", "cut"])
            if kind == "flip":
                data[at] ^= 1 << rng.randrange(8)
            elif kind == "drop":
                del data[at : at + rng.choice([1, 1, 40])]
            elif kind == "insert":
                data.insert(at, rng.randrange(256))
            else:
                data = data[: at + 1]
        path.write_bytes(data)
        survived += loads(path)
    assert survived < 60  # white space may change


def places(content, at=()):
    """Every place below a JSON value."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in items:
        yield (*at, key)
        if isinstance(value, dict | list):
            yield from places(value, (*at, key))


@pytest.mark.slow
def test_any_content_gives_a_robot_or_a_sentence_and_the_schema_agrees(path):
    """With a checksum that is right: what loads is by the schema, what is not by it never loads."""
    good = json.loads(path.read_text())
    rng, every = random.Random(1), list(places(good))
    validator = jsonschema.Draft202012Validator(SCHEMA)
    junk = (None, True, 0, -1, 1e308, 10**30, "x", [], {}, [1.0], [[1.0]], {"a": 1}, "\ud800")
    counts = {True: 0, False: 0}
    for _ in range(400):
        content = json.loads(json.dumps(good))
        *way, last = rng.choice(every)
        parent = content
        for key in way:
            parent = parent[key]
        if rng.random() < 0.3:
            del parent[last]
        elif rng.random() < 0.2 and isinstance(parent, dict):
            parent[rng.choice(["more", "value", "unit"])] = rng.choice(junk)
        else:
            parent[last] = rng.choice(junk)
        write(path, content)
        fine = loads(path)
        counts[fine] += 1
        written = json.loads(path.read_text())
        assert not fine or validator.is_valid(written), (way, last)
    assert min(counts.values()) > 5


# alone ---------------------------------------------------------------------------------------

ALONE = """
import sys
import equinox
import jax
import jaxtyping
jax.config.update("jax_enable_x64", True)
HERE = {name.split(".")[0] for name in sys.modules} | {"slipid", *sys.stdlib_module_names}
HERE.add("scipy")  # jaxlib takes it in when it first solves something
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] not in HERE:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Absent())
before = set(sys.modules)
import importlib, pkgutil
import slipid.robot
for found in pkgutil.walk_packages(slipid.robot.__path__, "slipid.robot."):
    importlib.import_module(found.name)
new = {name.split(".")[0] for name in set(sys.modules) - before}
print(sorted(new - {"slipid", "jax", *sys.stdlib_module_names}))
from slipid.robot.deployed import DeployedRobot
from slipid.robot.interface import Measurement
from slipid.robot.estimator import Odometry
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.controller import Controller
from slipid.robot.trajectory import rectangle
robot = DeployedRobot.load(sys.argv[1])
control_loop = ControlLoop(Odometry(robot), Controller(robot))
z = Measurement(wheel_angle=[0.0, 0.0, 0.0], current=[0.1, 0.1, 0.1])
state, said = control_loop.step(rectangle(), control_loop.init(), z, 0.05)
print(said.estimate.pose, said.estimate.surface, said.command)
"""


@pytest.mark.slow
def test_it_runs_where_there_is_jax_and_nothing_else(path):
    """Whatever JAX and equinox do not import themselves is absent."""
    words = [sys.executable, "-c", ALONE, str(path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()[:2]
    assert first == "[]"
    assert "['unknown' 'unknown' 'unknown']" in second
