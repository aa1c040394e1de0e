"""The folder of generated C: it builds everywhere, and tests itself."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from slipid.exports.c99.folder import c_files
from slipid.exports.ros.package import package_files
from slipid.robot.trajectory import rectangle
from tests.helpers.compiled_c import NEEDS_COMPILER, code

pytestmark = NEEDS_COMPILER


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """C folder of a small robot."""
    place = tmp_path_factory.mktemp("c")
    made = code("contact")
    for name, text in c_files(made.robot, made.loop, rectangle()).items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)
    return place


def built(folder, out, *flags, compiler="cc"):
    """The folder's own test, built in some way."""
    strict = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")
    sources = ("test/check.c", "src/slipid.c")
    command = [compiler, *strict, *flags, "-Isrc", "-o", str(out), *sources, "-lm"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("flags", [("-O0",), ("-O2",), ("-O2", "-DSLIPID_FLOAT")])
def test_it_compiles_without_a_warning_and_repeats_the_librarys_steps(
    folder, tmp_path, compiler, flags
):
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    done = built(folder, tmp_path / "check", *flags, compiler=compiler)
    assert done.returncode == 0, done.stderr
    result = subprocess.run([tmp_path / "check"], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout
    assert re.search(r"48 steps, \d+ numbers each: largest difference", result.stdout)


@pytest.mark.slow
def test_the_folders_test_fails_where_a_number_is_another_one(folder, tmp_path):
    golden = (folder / "test/golden.h").read_text()
    head, _, rest = golden.partition("golden_command[GOLDEN_STEPS][SLIPID_DRIVES] = {")
    changed = re.sub(r"(\d\.\d{4})\d", lambda m: f"{m[1]}{(int(m[0][-1]) + 1) % 10}", rest, count=1)
    assert changed != rest
    shutil.copytree(folder, tmp_path / "c")
    (tmp_path / "c/test/golden.h").write_text(
        f"{head}golden_command[GOLDEN_STEPS][SLIPID_DRIVES] = {{{changed}"
    )
    assert built(tmp_path / "c", tmp_path / "check", "-O1").returncode == 0
    result = subprocess.run([tmp_path / "check"], capture_output=True, text=True)
    assert result.returncode == 1
    assert "command" in result.stdout


@pytest.mark.slow
def test_no_sanitizer_finds_anything(folder, tmp_path):
    flags = ("-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    (tmp_path / "nothing.c").write_text("int main(void) { return 0; }\n")
    nothing = ["cc", *flags, "-o", tmp_path / "nothing", tmp_path / "nothing.c"]
    if subprocess.run(nothing, capture_output=True).returncode:
        pytest.skip("needs a compiler with sanitizers")
    done = built(folder, tmp_path / "check", *flags)
    assert done.returncode == 0, done.stderr
    result = subprocess.run([tmp_path / "check"], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nm") is None, reason="needs nm")
def test_no_heap_and_no_globals(folder, tmp_path):
    made = tmp_path / "slipid.o"
    subprocess.run(["cc", "-O1", "-c", "-o", made, folder / "src/slipid.c"], check=True)
    lines = subprocess.run(["nm", made], capture_output=True, text=True, check=True).stdout
    symbols = [line.split()[-2:] for line in lines.splitlines()]
    assert {kind for kind, _ in symbols} <= {"T", "t", "r", "U"}  # code, constants, what is called
    called = {name for kind, name in symbols if kind == "U"}
    assert called <= {
        *("sqrt", "exp", "log", "sin", "cos", "sincos", "atan2", "pow", "fmod", "floor"),
        *("memcpy", "memset", "memmove", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"),
    }


@pytest.mark.slow
def test_parts_for_float_and_for_double_cannot_be_linked(folder, tmp_path):
    made, flags = tmp_path / "slipid.o", ["-std=c99", "-O0", "-DSLIPID_FLOAT"]
    subprocess.run(["cc", *flags, "-c", "-o", made, folder / "src/slipid.c"], check=True)
    sources = [folder / "test/check.c", made, "-lm"]
    command = ["cc", "-I", folder / "src", "-o", tmp_path / "x", *sources]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode != 0
    assert "slipid_init" in done.stderr


ARDUINO = """
#include <stdio.h>
static unsigned long clock_ms;
static unsigned long millis(void) { return clock_ms; }
#include "Slipid.ino"
int main() {
  setup();
  for (clock_ms = 0; clock_ms <= 1000; clock_ms += 7) loop();
  printf("%g %g", (double)estimate.pose[0], (double)command[0]);
}
"""
"""Main loop that an Arduino core runs around a sketch."""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_the_sketch_for_arduino_compiles_and_runs(folder, tmp_path):
    (tmp_path / "main.cpp").write_text(ARDUINO)
    flags, strict = ["-DSLIPID_FLOAT", "-I", folder / "src"], ["-Wall", "-Wextra", "-Werror"]
    source, made = folder / "src/slipid.c", tmp_path / "slipid.o"
    subprocess.run(["cc", "-std=c99", *flags, "-c", "-o", made, source], check=True)
    words = ["g++", *strict, *flags, "-I", folder / "examples/Slipid", tmp_path / "main.cpp", made]
    subprocess.run([*words, "-o", tmp_path / "sketch", "-lm"], check=True)
    result = subprocess.run([tmp_path / "sketch"], capture_output=True, text=True, check=True)
    assert result.stdout == "0 0"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
@pytest.mark.parametrize("floats", [[], ["-DSLIPID_FLOAT"]])
def test_the_node_for_ros2_compiles_and_drives_a_robot(folder, tmp_path, floats):
    """With stubs of ROS 2 whose wheels follow: 2 s of a velocity ahead, then no message more."""
    robot = code("contact").robot
    for name, text in package_files(robot, (0.1, 0.2, 1e6, 1e6, 1e6, 0.3)).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    node, stubs = tmp_path / "node/src/slipid_node.cpp", Path(__file__).parents[1] / "helpers"
    for header in re.findall(r"#include <(\w+/.*)>", node.read_text()):
        (tmp_path / "stubs" / header).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "stubs" / header).write_text('#include "ros_stubs.hpp"\n')
        if not header.startswith("rclcpp"):
            assert (
                f"<depend>{header.split('/')[0]}</depend>"
                in (tmp_path / "node/package.xml").read_text()
            )
    source, made, flags = folder / "src/slipid.c", tmp_path / "slipid.o", [*floats, "-O1"]
    subprocess.run(["cc", "-std=c99", *flags, "-c", "-o", made, source], check=True)
    places = ["-I", folder / "src", "-I", tmp_path / "stubs", "-I", stubs]
    words = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", *flags, *places, node, made]
    subprocess.run([*words, "-o", tmp_path / "node/slipid_node", "-lm"], check=True)
    run = subprocess.run(
        [tmp_path / "node/slipid_node"], capture_output=True, text=True, check=True
    )
    driving, resting, last = run.stdout.splitlines()
    *speeds, ahead = map(float, driving.split())
    wanted = np.asarray(robot.inverse_kinematics)[:, :, 0] * 0.1
    np.testing.assert_allclose(speeds, wanted.mean(axis=0), atol=0.15 * np.abs(wanted).max())
    assert 0.1 < ahead < 0.21
    *speeds, further = map(float, resting.split())
    np.testing.assert_allclose(speeds, 0.0, atol=1e-3)
    assert ahead + 0.03 < further < ahead + 0.1
    assert last.startswith("1 0 drives_off=false gave_up=false stale=false")
    assert re.search(r" rejected_gyro=0 rejected_encoder=\d+ .* rejected_pose_fix=0$", last)
