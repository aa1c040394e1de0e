"""The demo: logs whose truth is known, the main job on them, and how near it came."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slipid.app import commands, runtime
from slipid.app.progress import Reporter
from slipid.data.files import write_bytes, write_json


@dataclass(frozen=True)
class Row:
    """Truth against estimate of one number."""

    path: str
    label: str
    unit: str
    truth: float
    value: float
    interval: tuple[float, float]
    verdict: str

    @property
    def inside(self) -> bool:
        """Whether the 90 % interval holds the truth."""
        return self.interval[0] <= self.truth <= self.interval[1]


def packaged_config(name: str) -> str:
    """Text of a config that ships with slipid."""
    import slipid

    package = Path(slipid.__file__).parent
    # beside the package in a clone, inside it in an installation
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).is_file():
            return (folder / name).read_text(encoding="utf-8")
    raise FileNotFoundError(f"{name} is missing from this installation of slipid")


def demo(out: Path, seed: int, report: Reporter) -> tuple[Any, dict[str, Any], list[Row]]:
    """Make logs, identify, predict unseen runs; the fit, the validation and the comparison."""
    runtime.start()
    from slipid.app import synthetic

    report.stage("making logs")
    drives = synthetic.grid()
    robot = synthetic.truth(drives)
    sensors = synthetic.Sensors()
    synthetic.write_logs(
        synthetic.make_logs(robot, drives, seed, sensors), robot, out / "logs", out / "truth"
    )
    # other headings than the fit sees, in the sessions it knows
    other = synthetic.grid(headings=9, turns=0)
    turned = [type(d)(d.surface, d.load, d.heading + 0.2, d.speed) for d in other]
    synthetic.write_logs(
        synthetic.make_logs(robot, turned, seed + 1000, sensors),
        robot,
        out / "unseen",
        out / "truth",
    )
    write_bytes(out / "robotino.toml", packaged_config("robotino.toml").encode())
    result = out / "result"
    done = commands.identify(out / "robotino.toml", out / "logs", result, report)
    found = commands.validate(result, out / "unseen", report)
    write_json(result / "validation.json", found)
    return done, found, compared(done.fit, robot)


def compared(fit: Any, robot: Any) -> list[Row]:
    """Every number that was fitted beside its truth."""
    from slipid.parameter import entries

    known = {e.path: np.atleast_1d(np.asarray(e.get(robot), float)) for e in entries(robot)}
    rows = []
    for e in fit.parameters.values():
        if e.verdict == "fixed" or e.path not in known:
            continue
        values = e.value if e.labels else [e.value]
        intervals = e.interval90 if e.labels else [e.interval90]
        labels = e.labels or ("",)
        for label, truth, value, interval in zip(
            labels, known[e.path], values, intervals, strict=True
        ):
            rows.append(Row(e.path, label, e.unit, float(truth), value, tuple(interval), e.verdict))
    return rows


def real_logs() -> Path | None:
    """Folder of real logs, where this machine has them: SLIPID_DATA, else ../shared/data."""
    for folder in (os.environ.get("SLIPID_DATA"), "../shared/data"):
        if folder and (Path(folder) / "robotino2022").is_dir():
            return Path(folder)
    return None
