"""Generated C under every compiler, on small controllers, under sanitizers, and fuzzed.

    SLIPID_FUZZ_S=600  seconds of fuzzing, half of them in double and half in float

How it is run is at the head of `export_builds.py`.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from slipid.exports.c99.code import Code
from slipid.exports.c99.folder import c_files
from slipid.exports.golden import golden
from slipid.robot.trajectory import rectangle
from tests.benchmarks.export_builds import HERE, KINDS, control_loop, needs, ran, three_floors
from tests.benchmarks.quick import QUICK, quick

WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")
FLAGS = ("-fno-math-errno", "-fno-trapping-math")
"""Flags that the exported folder asks CMake and PlatformIO for."""
FUZZ_S = float(os.environ.get("SLIPID_FUZZ_S", quick("600", "4")))
ROWS = quick(("slip_odometry", "contact"), ("slip_odometry",))
CHIPS = {
    "cortex-m4": ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
    "cortex-m7": ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-sp-d16"),
}
CODE_BAR, STATE_BAR = 64 * 1024, 8 * 1024
"""Of three wheels on three floors in float [byte]; what was learnt of the floors is constants."""
SIZES = """#include "slipid.h"
char state[sizeof(slipid_state)];
char estimate[sizeof(slipid_estimate)];
char reading[sizeof(slipid_reading)];
"""
MAIN = """#include "slipid.h"
static slipid_state state;
static slipid_reading reading;
static slipid_estimate estimate;
volatile slipid_real in[6], out[SLIPID_WHEELS];
int main(void) {
  slipid_real reference[6] = {0}, command[SLIPID_WHEELS];
  slipid_init(&state, reference);
  slipid_nothing(&reading);
  for (;;) {
    for (int k = 0; k < SLIPID_WHEELS; ++k) reading.wheel_angle[k] = in[k];
    slipid_step(&state, &reading, reference, in[5], &estimate, command);
    for (int k = 0; k < SLIPID_WHEELS; ++k) out[k] = command[k];
  }
}
void _exit(int code);
void _exit(int code) { (void)code; for (;;) {} }
"""


@cache
def _files(row: str) -> dict[str, str]:
    return c_files(three_floors(), control_loop(row), rectangle())


def folder_of(row: str, into: Path) -> Path:
    """A row's exported C folder."""
    for name, text in _files(row).items():
        path = into / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return into


# compilers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("compiler", [pytest.param(c, marks=needs(c)) for c in ("gcc", "clang")])
@pytest.mark.parametrize("row", ROWS)
def test_compilers(tmp_path, row, compiler):
    folder, refused = folder_of(row, tmp_path), []
    for kind, flags in KINDS.items():
        for level in ("-O0", "-O2", "-O3"):
            words = [compiler, *WARNINGS, level, *flags, "-Isrc", "-o", "check"]
            name = f"{row} {compiler} {level} {kind}"
            try:
                ran([*words, "test/check.c", "src/slipid.c", "-lm"], folder)
                said = ran(["./check"], folder).strip()
            except AssertionError as error:
                said = f"refused, {error}"
                refused.append(name)
            print(f"\n{name}: {said}", end="")
    assert not refused


def sections(text: str) -> tuple[int, int]:
    """Bytes of code and of constants, as `size -A` tells them."""
    rows = re.findall(r"^\.(\S+)\s+(\d+)", text, re.MULTILINE)
    sums = [sum(int(n) for name, n in rows if name.startswith(k)) for k in ("text", "rodata")]
    return sums[0], sums[1]


def symbols(text: str) -> dict[str, int]:
    """Sizes of symbols, as `nm -S` tells them."""
    return {n: int(s, 16) for s, n in re.findall(r"^\S+ (\S+) \S (\w+)$", text, re.MULTILINE)}


@dataclass(frozen=True)
class Sizes:
    """What a row takes of a chip [byte].

    Attributes:
        code, tables: of estimator and controller; whole: a program with the C library in it.
        held: of the structs; stack: of the functions that take more than a little.
        calls: of the C library and the compiler's own.
    """

    code: int
    tables: int
    whole: int
    held: dict[str, int]
    stack: dict[str, int]
    calls: tuple[str, ...]


@cache
def _bare(row: str) -> Code:
    return Code(three_floors(), control_loop(row), rectangle())


def sizes(row: str, chip: str, folder: Path) -> Sizes:
    """Build a row without a path, in float, for a chip."""
    tool, made = "arm-none-eabi-", _bare(row)
    texts = {"slipid.h": made.header(), "slipid.c": made.source()}
    for name, text in (texts | {"sizes.c": SIZES, "main.c": MAIN}).items():
        (folder / name).write_text(text)
    chosen = [*WARNINGS, "-Wdouble-promotion", "-Os", *FLAGS, *CHIPS[chip], "-DSLIPID_FLOAT"]
    words = [f"{tool}gcc", *chosen]
    ran([*words, "-fstack-usage", "-c", "slipid.c", "sizes.c"], folder)
    code, tables = sections(ran([f"{tool}size", "-A", "slipid.o"], folder))
    linked = ["main.c", "slipid.o", "--specs=nano.specs", "--specs=nosys.specs", "-lm"]
    ran([*words, "-o", "whole.elf", *linked], folder, range(256))
    rows = [line.split("\t") for line in (folder / "slipid.su").read_text().splitlines()]
    stack = {r[0].rsplit(":", 1)[-1]: int(r[1]) for r in rows}
    return Sizes(
        code,
        tables,
        sum(sections(ran([f"{tool}size", "-A", "whole.elf"], folder))),
        symbols(ran([f"{tool}nm", "-S", "sizes.o"], folder)),
        {name: n for name, n in stack.items() if n > 100},
        tuple(sorted(re.findall(r"U (\w+)", ran([f"{tool}nm", "-u", "slipid.o"], folder)))),
    )


@needs("arm-none-eabi-gcc")
@pytest.mark.parametrize("chip", CHIPS)
@pytest.mark.parametrize("row", ROWS)
def test_small_controllers(tmp_path, row, chip):
    s = sizes(row, chip, tmp_path)
    print(
        f"\n{row} {chip}: .text {s.code} ({s.code / CODE_BAR:.2f} of the bar), .rodata "
        f"{s.tables}; state {s.held['state']} "
        f"({s.held['state'] / STATE_BAR:.2f} of the bar), estimate {s.held['estimate']}, reading "
        f"{s.held['reading']}; stack {s.stack}; whole program {s.whole}; it calls "
        f"{', '.join(s.calls)}"
    )
    assert not [name for name in s.calls if name.startswith("__aeabi_d")], "double arithmetic"
    assert QUICK or s.code <= CODE_BAR
    assert QUICK or s.held["state"] <= STATE_BAR


# sanitizers and fuzzing -----------------------------------------------------------------------

SANE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("compiler", [pytest.param(c, marks=needs(c)) for c in ("gcc", "clang")])
@pytest.mark.parametrize("row", ROWS)
def test_sanitizers(tmp_path, row, compiler, kind):
    folder = folder_of(row, tmp_path)
    words = [compiler, "-std=c99", *SANE, "-fsanitize=float-cast-overflow", *KINDS[kind], "-Isrc"]
    ran([*words, "-o", "check", "test/check.c", "src/slipid.c", "-lm"], folder)
    print(f"\n{row} {compiler} {kind}: {ran(['./check'], folder).strip()}", end="")


def seeds(row: str, into: Path) -> None:
    """Drives to begin with, as `fuzz_step.c` reads them: raw numbers, and wheels that turn on."""
    into.mkdir()
    steps = [
        b"\x00" + given.tobytes() for given in golden(control_loop(row)).given.astype(np.float64)
    ]
    (into / "raw").write_bytes(b"".join(steps))
    rng = np.random.default_rng(0)
    for number in range(8):
        turns = [
            b"\x02"
            + rng.integers(0, 256, 6, np.uint8).tobytes()
            + bytes([3 + 4 * rng.integers(60)])
            for _ in range(12)
        ]
        (into / f"turning{number}").write_bytes(b"".join(turns))
    odd = [np.inf, -np.inf, np.nan, 1e300, -1e300, 1e-310, 0.0, 1e9, 1e38, -1.0]
    for k, x in enumerate(odd):
        one = [b"\x01" + bytes([place]) + np.float64(x).tobytes() for place in range(26)]
        (into / f"odd{k}").write_bytes(steps[0] + b"".join(b + steps[1] for b in one))


@needs("clang")
@pytest.mark.parametrize("kind", KINDS)
def test_fuzzing(tmp_path, kind):
    folder = folder_of("contact", tmp_path)
    words = ["clang", "-std=c99", *SANE, "-fsanitize=fuzzer", *KINDS[kind], "-Isrc", "-o", "fuzz"]
    ran([*words, HERE / "fuzz_step.c", "src/slipid.c", "-lm"], folder)
    seeds("contact", folder / "corpus")
    limits = [f"-max_total_time={max(1, round(FUZZ_S / 2))}", "-max_len=4096", "-timeout=25"]
    said = ran(["./fuzz", "corpus", *limits, "-print_final_stats=1"], folder, range(-20, 256))
    last = re.findall(r"cov: (\d+) ft: (\d+) corp: (\S+)", said)[-1:]
    runs = re.findall(r"stat::number_of_executed_units: (\d+)", said)
    print(f"\n{kind}: {limits[0][16:]} s, runs {runs}, cov, ft and corp {last}")
    found = sorted(p for p in folder.iterdir() if p.name.startswith(("crash-", "timeout-")))
    for path in found:
        tail = "\n".join(said.splitlines()[-60:])
        print(f"{path.name}: {path.read_bytes().hex()}\n{tail}")
    assert not found
