"""Identify the reference robots from public logs, and write their files beside this script.

    python configs/robots/derive.py DATA [NAME ...] [--results DIR]

DATA is a folder with the public logs in the folders that `ROBOTS` names. Without names, all robots
are identified, each in a process of its own: what a process computed before changes the last bits
of a fit. They take five minutes on two cores. With --results, the result folders are kept.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import slipid
from slipid.app.bench import identify_bench
from slipid.app.config import BenchMotors, Config, read_config
from slipid.app.identify import checked_task, identify
from slipid.app.logs import layout_of
from slipid.app.reference_robots import (
    MULTIPLIERS,
    SCHEMA,
    ReferenceFloor,
    ReferenceNumber,
    ReferenceOrigin,
    ReferenceRobot,
    ReferenceSource,
)
from slipid.support.content import Content
from slipid.support.files import read_json, write_json
from slipid.support.progress import Reporter

HERE = Path(__file__).resolve().parent
DIGITS = 6
"""Significant digits of the numbers in the files."""
WORST_FIRST = ("not_identified", "weak", "identified")


@dataclass(frozen=True)
class PublicLogs:
    """Public logs of one robot.

    Attributes:
        config: config of the robot, one folder above this script.
        folder: folder of the logs below the data folder.
        about: what the robot is, in a few words.
        title, url, doi, licence: source of the logs, as in `ReferenceSource`.
        notes: what to know before using the numbers, one sentence each.
    """

    config: str
    folder: str
    about: str
    title: str
    url: str
    doi: str | None
    licence: str
    notes: tuple[str, ...]


_NO_CURRENT = "no usable current was logged: motors and friction are not identified"
_NO_VOLTAGE = (
    "no voltage was logged: R and C_e are those of the datasheet, and friction torques are "
    "identified only relative to C_e"
)
_SLIPPAGE = "https://github.com/BrOleg5/research-wheel-slippage"
_DRIVE = "https://github.com/norlab-ulaval/doughnut_calib"
ROBOTS = {
    "husky": PublicLogs(
        "husky.toml",
        "drive_skid",
        "Clearpath Husky, skid steer with four tyres, on wet grass",
        "Husky on wet grass, steps of the commanded speeds (doughnut_calib, commit 1d6d210)",
        _DRIVE,
        "10.48550/arXiv.2309.10718",
        "BSD-3-Clause",
        (_NO_CURRENT, "21 of 40 runs were set aside: scan matching jumps on wet grass"),
    ),
    "omni3": PublicLogs(
        "omni3.toml",
        "omni3_optitrack",
        "three omni wheels on a hard floor, under motion capture",
        "Three-wheeled omni robot driven by joystick, tracked by OptiTrack (optiodom, commit "
        "8e025fd)",
        "https://github.com/sousarbarb/optiodom",
        "10.1007/s10846-022-01630-3",
        "MIT",
        (_NO_CURRENT, "four runs on one floor: a constant slip looks the same as smaller wheels"),
    ),
    "robotino": PublicLogs(
        "robotino2022.toml",
        "robotino2022",
        "FESTO Robotino 2, three omni wheels, on a table and three carpets",
        "Robotino on four floors, straight runs under a camera (commit b4303b4)",
        _SLIPPAGE,
        None,
        "Apache-2.0",
        (_NO_VOLTAGE, "straight runs alone: the effective base is not identified"),
    ),
    "robotino_motor": PublicLogs(
        "robotino2022_motor.toml",
        "robotino2022",
        "the Robotino's motors (Dunkermotoren GR 42x25), on a bench",
        "Steps of the motor speeds, wheels in the air (commit b4303b4)",
        _SLIPPAGE,
        None,
        "Apache-2.0",
        (_NO_VOLTAGE, "values refer to the motor shaft, behind which gear and wheel turn too"),
    ),
    "warthog": PublicLogs(
        "warthog.toml",
        "drive_skid",
        "Clearpath Warthog, skid steer with four tyres, on grass and asphalt",
        "Warthog on grass and asphalt, steps of the commanded speeds (doughnut_calib, commits "
        "7c1dd13, 77a35d2, 77bc176)",
        _DRIVE,
        "10.48550/arXiv.2309.10718",
        "BSD-3-Clause",
        (
            _NO_CURRENT,
            "four runs alone on asphalt",
            "with another shape of the saturating forces (tanh) the front carried 56 % of the "
            "weight, here 43 %: load shares, creep and rolling resistance are less certain than "
            "their intervals",
        ),
    ),
}


def derive(name: str, data: Path, out: Path, report: Reporter) -> ReferenceRobot:
    """Return a reference robot, identified from its public logs.

    Args:
        name: its name, a key of `ROBOTS`.
        data: folder with the folders of public logs.
        out: folder to which the result of `slipid identify` is written.
        report: reporter of the progress.

    Raises:
        DataError: logs are missing or wrong.
    """
    one = ROBOTS[name]
    path, logs = HERE.parent / one.config, data / one.folder
    config = read_config(path)
    if isinstance(config.content.robot, BenchMotors):
        identify_bench(config, logs, out, report)
    else:
        identify(checked_task(path, logs, report), logs, out, report)
    return reference_of(name, config, read_json(out / "identified.json", "what identify wrote"))


def reference_of(name: str, config: Config, found: Content) -> ReferenceRobot:
    """Return the reference robot `name` from the content of its identified.json."""
    one, trust = ROBOTS[name], found.get("trust")
    errors = {} if trust is None else trust["held_out_error_over_path"]
    floors = {}
    for floor, each in errors.items():
        model = found["selected_model"][floor]
        rounded = {key: _short(error) for key, error in (*each.items(), ("selected", each[model]))}
        floors[floor] = ReferenceFloor(
            trust["runs"][floor], trust["held_out"][floor], model, rounded
        )
    data = found["data"]
    return ReferenceRobot(
        schema=SCHEMA,
        name=name,
        about=one.about,
        drive=config.content.robot.drive,
        nominal={} if trust is None else _nominal(config),
        trust=_word(found) if trust is None else trust["verdict"],
        notes=list(one.notes),
        floors=floors,
        numbers=dict(sorted(_numbers(found))),
        source=ReferenceSource(
            one.title, one.url, one.doi, one.licence, data["hash"], len(data["runs"])
        ),
        origin=ReferenceOrigin(
            command=f"python configs/robots/derive.py DATA {name}",
            config=one.config,
            slipid=slipid.__version__,
            date=datetime.now(UTC).date().isoformat(),
        ),
    )


def _word(found: Content) -> str:
    """Return the trust in a fit of motors on a bench."""
    return "trusted" if found["explained"] else "not to be trusted"


def _nominal(config: Config) -> dict[str, float | bool | str | list[float]]:
    """Return the sizes in a config, keyed by the options of `slipid new`."""
    given = config.content.wheels.model_dump(
        exclude_none=True, exclude={"drive", "limits", "sensors", "actuators", "roller_angle_deg"}
    )
    if (azimuths := given.pop("wheel_azimuths_deg", None)) is not None:
        given |= {"wheels": len(azimuths), "azimuths_deg": azimuths}
    for half, whole in (("half_length_m", "wheelbase_m"), ("half_width_m", "track_m")):
        if half in given:
            given[whole] = 2 * given.pop(half)
            given["shared"] = "drives" in given
    given.pop("drives", None)
    layout = layout_of(config, config.content.logs[0])
    return given | {"ticks_per_revolution": layout.ticks_per_revolution or 0.0}


def _numbers(found: Content) -> Iterator[tuple[str, ReferenceNumber]]:
    """Yield the numbers of the robot, without those of the pose sensor and of sessions."""
    for part in ("parameters", "derived"):
        for path, number in found[part].items():
            if number["verdict"] != "fixed" and not path.startswith("camera."):
                yield path, _number(number)
    calibration = found.get("calibration")
    if calibration is None:
        return
    base = "track" if "track_m" in calibration["nominal"] else "base"
    for floor, lengths in calibration["surfaces"].items():
        for key, named in (("rolling_radius_m", "wheel_radius"), (f"effective_{base}_m", "track")):
            values, of = lengths[key], "base_m" if base == "base" else "track_m"
            nominal = calibration["nominal"]["wheel_radius_m" if named == "wheel_radius" else of]
            yield f"calibration.surfaces.{floor}.{key}", _calibrated(values)
            yield f"{MULTIPLIERS}.{floor}.{named}", _calibrated(values, 1 / nominal, "1")
    for floor, centre in calibration["centre_of_rotation_m"].items():
        if centre["verdict"] != "fixed":
            yield f"calibration.centre_of_rotation_m.{floor}", _calibrated(centre)


def _number(number: Content) -> ReferenceNumber:
    """Return a number of the tables `parameters` and `derived`."""
    value, ends = number["value"], number["interval90"]
    several = isinstance(value, list)
    return ReferenceNumber(
        tuple(map(_short, value)) if several else _short(value),
        number["unit"],
        tuple(map(_pair, ends)) if several else _pair(ends),
        number["verdict"],
    )


def _calibrated(
    given: Content | list[Content], factor: float = 1.0, unit: str = ""
) -> ReferenceNumber:
    """Return calibrated numbers times a factor, in another unit if one is given."""
    several = given if isinstance(given, list) else [given]
    value = tuple(_short(factor * one["value"]) for one in several)
    ends = tuple(_pair([factor * end for end in one["interval90"]]) for one in several)
    verdict = min((one["verdict"] for one in several), key=WORST_FIRST.index)
    return ReferenceNumber(
        value if several is given else value[0],
        unit or several[0]["unit"],
        ends if several is given else ends[0],
        verdict,
    )


def _pair(ends: list[float]) -> tuple[float, float]:
    return _short(ends[0]), _short(ends[1])


def _short(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def main() -> None:
    """Identify the robots that the command line names, and write their files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with the public logs")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(ROBOTS))
    parser.add_argument("--results", type=Path, help="folder for the result folders, to keep them")
    given = parser.parse_args()
    if unknown := set(given.names) - ROBOTS.keys():
        parser.error(f"no such robot: {', '.join(sorted(unknown))}; known: {', '.join(ROBOTS)}")
    if len(names := given.names or list(ROBOTS)) > 1:
        kept = [] if given.results is None else ["--results", str(given.results)]
        for name in names:
            subprocess.run([sys.executable, __file__, str(given.data), name, *kept], check=True)
        return
    (name,) = names
    with TemporaryDirectory() as scratch, Reporter() as report:
        out = Path(scratch) if given.results is None else given.results / name
        found = derive(name, given.data, out, report)
    write_json(HERE / f"{name}.json", found.to_json())
    sys.stdout.write(f"{HERE / name}.json\n")


if __name__ == "__main__":
    main()
