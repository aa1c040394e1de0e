"""Public logs of real motors, which stay outside: SLIPID_MOTOR_LOGS names the folder with them.

    padova-2021/  github.com/jacopisky/ControlLaboratory, no licence stated, commit f2103550:
                  Jacopo/LAB0/data/{least_square_positive,least_square_negative,accel_decel}.mat
    padova-2023/  github.com/emavit/ControlEngineeringLaboratory, no licence stated, commit
                  8dfa0417: LAB0/LAB Simulations/{positive_stair,negative_stair,triang_ref}.mat
    qube-3/       github.com/Kris9elsen/Qube_Servo_3_Controller, GPL-3.0, commit 5d6c69c9:
                  equations/data3_1v.csv

Both first ones are of benches of a course at the University of Padova, with a Faulhaber 2338S006S,
a gear of 14:1 and a shunt of 0.5 ohm; the speed was measured behind the gear. Their voltage is that
of the controller times the gain of the amplifier, 0.598 from its resistors, so that the resistance
contains the shunt. In 2021 the current was logged behind a low-pass filter of 20 Hz. The third one
is of a Quanser QUBE-Servo 3 at a constant 1 V; its speeds are doubled, as its authors do, and its
resistance is 1 V over the current of the held shaft in `data_stall_1v.csv`.
"""

import hashlib
import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab._mio5 import MatFile5Reader

from slipid.infer.bench.motor import BenchRecord

FOLDER = Path(os.environ.get("SLIPID_MOTOR_LOGS", "no/motor/logs"))
GEAR = 14.0
"""Ratio of the gear of the benches in Padova."""
AMPLIFIER = 1600 / 9100 * (1 + 1200 / 500)
"""Gain of their amplifier, from its resistors."""


@dataclass(frozen=True)
class PublicMotor:
    """A motor with a public log.

    Attributes:
        name: name in the table.
        folder: folder of its files.
        files: names of its logs, without suffix.
        read: reader of a log.
        resistance: resistance that was measured otherwise [ohm].
        back_emf: back-EMF constant that was measured otherwise [V s/rad].
        inductance: inductance of the data sheet, None if it is not known [H].
    """

    name: str
    folder: str
    files: tuple[str, ...]
    read: Callable[[Path], BenchRecord]
    resistance: float
    back_emf: float
    inductance: float | None

    @property
    def path(self) -> Path:
        return FOLDER / self.folder

    def records(self) -> list[BenchRecord]:
        return [self.read(self.path / name) for name in self.files]


def _record(path: Path, time: np.ndarray, *channels: np.ndarray) -> BenchRecord:
    voltage, current, speed = (np.asarray(x, float) for x in channels)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return BenchRecord(
        name=path.name,
        sha256=sha256,
        time=np.asarray(time, float),
        voltage=voltage,
        current=current,
        speed=speed,
    )


def padova_2021(path: Path) -> BenchRecord:
    """Return a log of the course in 2021, whose speeds are in deg/s at the motor or the load."""
    path = path.with_suffix(".mat")
    log = loadmat(path, squeeze_me=True, struct_as_record=False)
    at_motor = "wm_best_meas" in log
    speed = log["wm_best_meas"] if at_motor else log["al_best_meas1"]
    degrees = speed.signals.values * (1.0 if at_motor else GEAR)
    voltage = AMPLIFIER * log["thl_u_best"].signals[1].values
    current = log["ia_best"].signals.values
    return _record(path, log["ia_best"].time, voltage, current, np.deg2rad(degrees))


def padova_2023(path: Path) -> BenchRecord:
    """Return a log of the course in 2023: seven MATLAB `timeseries`, speeds in rpm at the load."""
    path = path.with_suffix(".mat")
    objects = loadmat(path)["__function_workspace__"].tobytes()
    # The objects are a MAT file of their own, after a short header.
    reader = MatFile5Reader(
        io.BytesIO(b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + objects[8:]),
        squeeze_me=True,
        struct_as_record=False,
    )
    reader.initialize_read()
    reader.read_file_header()
    header, _ = reader.read_var_header()
    cells = reader.read_var_array(header, False).item().MCOS["arr"][0]
    arrays = [x for x in cells if isinstance(x, np.ndarray) and x.dtype == float and len(x) > 9]
    # wref, wl_meas, thref, thl_meas, ia, u, e, each after its time
    time, speed, current, voltage = arrays[0], arrays[3], arrays[9], arrays[11]
    return _record(path, time, AMPLIFIER * voltage, current, GEAR * speed * np.pi / 30)


def qube(path: Path) -> BenchRecord:
    """Return a log of the QUBE-Servo 3."""
    path = path.with_suffix(".csv")
    log = np.genfromtxt(path, delimiter=",", names=True)
    return _record(path, log["time"], log["voltage"], log["current"], 2 * log["omega1"])


MOTORS = (
    PublicMotor(
        "Faulhaber 2338S, Padova 2021",
        "padova-2021",
        ("least_square_positive", "least_square_negative", "accel_decel"),
        padova_2021,
        3.1,
        7.68e-3,
        0.18e-3,
    ),
    PublicMotor(
        "Faulhaber 2338S, Padova 2023",
        "padova-2023",
        ("positive_stair", "negative_stair", "triang_ref"),
        padova_2023,
        3.1,
        7.68e-3,
        0.18e-3,
    ),
    PublicMotor("QUBE-Servo 3, 1 V", "qube-3", ("data3_1v",), qube, 8.65, 0.0422, None),
)
"""Motors with public logs. But for the resistance of the last one, numbers are of data sheets."""
