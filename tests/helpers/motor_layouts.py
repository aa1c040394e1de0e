"""Small logs of one motor in the layout of each tool that `slipid motor` reads, all made here.

`LAYOUTS` lists them; every writer stores the same signals, so that the records that are read can be
compared with them.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slipid.data.reading.motor_layout import MotorOptions

ROWS, STEP = 400, 0.02
TESTS = ("quasistatic-forward", "quasistatic-reverse", "dynamic-forward", "dynamic-reverse")
OLD_TESTS = ("slow-forward", "slow-backward", "fast-forward", "fast-backward")
TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class Signals:
    """Signals of a motor in SI units, a row every `STEP`."""

    time: np.ndarray
    voltage: np.ndarray
    current: np.ndarray
    speed: np.ndarray
    angle: np.ndarray


def signals(start: float = 5.0, rows: int = ROWS, step: float = STEP) -> Signals:
    """Slow oscillations, of another phase in each signal."""
    time = start + step * np.arange(rows)
    speed = 120 * np.sin(1.3 * time - 0.2)
    angle = -120 / 1.3 * np.cos(1.3 * time - 0.2)
    return Signals(time, 8 * np.sin(1.3 * time), 2 * np.cos(1.3 * time) + 0.3, speed, angle)


def _csv(path: Path, header: str, columns: list[np.ndarray], delimiter: str = ",") -> Path:
    """Write lines above the numbers, then the columns."""
    rows = (delimiter.join(f"{x:.9g}" for x in row) for row in zip(*columns, strict=True))
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def plain(path: Path, s: Signals) -> Path:
    return _csv(path, "t,U,I,w", [s.time, s.voltage, s.current, s.speed])


def without_voltage(path: Path, s: Signals) -> Path:
    return _csv(path, "t,I,w", [s.time, s.current, s.speed])


def vesc(path: Path, s: Signals, start_ms: float = 0.0, foc: bool = True) -> Path:
    """VESC tool; without field-oriented control its columns of the axes are zero."""
    names = (
        "ms_today;input_voltage;temp_mos_max;temp_motor;current_motor;current_in;d_axis_current;"
        "q_axis_current;erpm;duty_cycle;amp_hours_used;tachometer;encoder_position;fault_code;"
        "vesc_id;d_axis_voltage;q_axis_voltage;ms_today_setup;current_motor_setup;"
        "speed_meters_per_sec;roll;yaw;gyroX;gnss_gVel;"
    )
    zero = np.zeros(len(s.time))
    today = (start_ms + 1e3 * s.time) % 86_400_000
    q = (s.current, s.voltage) if foc else (zero, zero)
    made = {
        "ms_today": today,
        "input_voltage": zero + 24,
        "current_motor": s.current,
        "current_in": 0.1 * s.current,
        "q_axis_current": q[0],
        "erpm": 7 * s.speed * 60 / TURN,
        "duty_cycle": s.voltage / 24,
        "q_axis_voltage": q[1],
        "ms_today_setup": today - 70,
        "speed_meters_per_sec": 0.1 * s.speed,
    }
    columns = [made.get(name, zero) for name in names.strip(";").split(";")]
    rows = (";".join(f"{x:.9g}" for x in row) + ";" for row in zip(*columns, strict=True))
    path.write_text("\n".join([names, *rows]) + "\n")
    return path


def vesc_six_step(path: Path, s: Signals) -> Path:
    return vesc(path, s, foc=False)


def sysid_csv(path: Path, s: Signals) -> Path:
    """SysId's export, with an empty line below the names, as it writes it."""
    lines = ["Timestamp (s),Test,Volts (V),Position (rot),Velocity (rot/s)", ""]
    for k, row in enumerate(zip(s.time, s.voltage, s.angle / TURN, s.speed / TURN, strict=True)):
        time, *rest = (f"{x:.9g}" for x in row)
        lines.append(",".join([time, TESTS[4 * k // len(s.time)], *rest]))
    path.write_text("\n".join(lines) + "\n")
    return path


def _json(path: Path, kind: str, columns: list[np.ndarray]) -> Path:
    parts = np.array_split(np.stack(columns, axis=1), 4)
    tests = {name: part.tolist() for name, part in zip(OLD_TESTS, parts, strict=True)}
    # The numbers are turns; the units are those that SysId shows.
    content = {**tests, "sysid": True, "test": kind, "units": "Meters", "unitsPerRotation": 0.3}
    path.write_text(json.dumps(content))
    return path


def sysid_json(path: Path, s: Signals) -> Path:
    return _json(path, "Simple", [s.time, s.voltage, s.angle / TURN, s.speed / TURN])


def old_json(path: Path, s: Signals) -> Path:
    """frc-characterization: ten numbers in a row, the right side like the left one."""
    zero = np.zeros(len(s.time))
    pairs = [x for one in (s.voltage, s.angle / TURN, s.speed / TURN) for x in (one, one)]
    return _json(path, "Simple", [s.time, zero + 12, zero, *pairs, zero])


def drivetrain_json(path: Path, s: Signals) -> Path:
    """A drivetrain, whose right side turns at half of the left side's voltage and speed."""
    turns, rate = s.angle / TURN, s.speed / TURN
    sides = [s.voltage, s.voltage / 2, turns, turns / 2, rate, rate / 2]
    return _json(path, "Drivetrain", [s.time, *sides, 0 * turns, 0 * turns])


def record(entry: int, time_s: float, payload: bytes) -> bytes:
    """A record of a data log, each field with as few bytes as it needs."""
    fields = [entry, len(payload), round(1e6 * time_s)]
    sizes = [max(1, (x.bit_length() + 7) // 8) for x in fields]
    bits = sizes[0] - 1 | (sizes[1] - 1) << 2 | (sizes[2] - 1) << 4
    packed = (x.to_bytes(n, "little") for x, n in zip(fields, sizes, strict=True))
    return bytes([bits]) + b"".join(packed) + payload


def started(entry: int, name: str, kind: str, metadata: str = "") -> bytes:
    """The control record that starts an entry."""
    texts = b"".join(struct.pack("<I", len(t)) + t.encode() for t in (name, kind, metadata))
    return record(0, 0.0, struct.pack("<BI", 0, entry) + texts)


def wpilog(path: Path, s: Signals, names: Mapping[str, str] | None = None) -> Path:
    """A data log as SysIdRoutineLog writes it: entries a few microseconds after each other."""
    known = names or {n: f"{n}-motor-flywheel" for n in ("voltage", "position", "velocity")}
    units = {"voltage": "Volt", "position": "Rotation", "velocity": "Rotation per Second"}
    made = {"voltage": s.voltage, "position": s.angle / TURN, "velocity": s.speed / TURN}
    raw = [b"WPILOG\x00\x01", struct.pack("<I", 5), b"extra"]
    raw += [started(k, known[n], "double", units[n]) for k, n in enumerate(known, start=1)]
    raw += [started(4, "NT:/enabled", "boolean"), started(5, "blob", "raw")]
    raw += [started(6, "sysid-test-state-flywheel", "string"), record(6, s.time[0] - 1, b"none")]
    raw += [record(4, s.time[0], b"\x01"), record(5, s.time[0], b"abc")]
    for k, time in enumerate(s.time):
        for at, name in enumerate(known, start=1):
            raw.append(record(at, time + 2e-5 * at, struct.pack("<d", made[name][k])))
        if k % (len(s.time) // 4) == 0:
            state = TESTS[min(4 * k // len(s.time), 3)]
            raw.append(record(6, time, state.encode()))
    raw.append(record(6, s.time[-1] + 0.01, b"none"))
    path.write_bytes(b"".join(raw))
    return path


def odrive(path: Path, s: Signals) -> Path:
    names = (
        "time,axis0.encoder.pos_estimate,axis0.encoder.vel_estimate,"
        "axis0.motor.current_control.Iq_measured,axis0.motor.current_control.Id_measured,"
        "axis0.motor.current_control.v_current_control_integral_q,vbus_voltage,"
        "axis0.controller.vel_setpoint"
    )
    zero = np.zeros(len(s.time))
    q = [s.current, zero + 0.1, s.voltage, zero + 24, s.speed]
    return _csv(path, names, [s.time, s.angle / TURN, s.speed / TURN, *q])


def moteus(path: Path, s: Signals) -> Path:
    names = "timestamp,mode,position,velocity,torque,q_current,d_current,voltage,q_voltage,fault"
    zero = np.zeros(len(s.time))
    q = [0.1 * s.current, s.current, zero + 0.1, zero + 24, s.voltage, zero]
    return _csv(path, names, [s.time, zero + 10, s.angle / TURN, s.speed / TURN, *q])


def rigol(path: Path, s: Signals) -> Path:
    step = s.time[1] - s.time[0]
    head = f"X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,{s.time[0]:.9g},{step:.9g}"
    rows = (f"{k},{u:.9g},0," for k, u in enumerate(s.voltage))
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def rigol_memory(path: Path, s: Signals) -> Path:
    step = s.time[1] - s.time[0]
    rows = (f"{u:.9g}," for u in s.voltage)
    head = f"CH1(V),t0 = {s.time[0]:.9g}s, tInc = {step:.9g}s,"
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def siglent(path: Path, s: Signals) -> Path:
    head = (
        f"Record Length,{len(s.time)}\nSample Interval,0.001\nVertical Units,CH1:V CH2:V,,\n"
        "Horizontal Units,s,,\nModel Number,SDS1104,,\n\nSource,CH1,CH2\nSecond,Volt,Volt"
    )
    return _csv(path, head, [s.time, s.voltage, 0 * s.voltage])


def siglent_one(path: Path, s: Signals) -> Path:
    head = "Record Length,Analog:14000\nSample Rate,1000.0\nVertical Scale,CH1: 0.05\n"
    head += "Horizontal Scale, 0.000010000\nSecond,Volt"
    return _csv(path, head, [s.time, s.voltage])


def tektronix(path: Path, s: Signals) -> Path:
    head = (
        "Model,MSO46\nFirmware Version,1.1\n\nWaveform Type,ANALOG,,\nHorizontal Units,s,,\n"
        f"Sample Interval,0.001,,\nRecord Length,{len(s.time)},,\nVertical Units,V,,V\n"
        "Label,,,\n\nTIME,CH1,CH2"
    )
    return _csv(path, head, [s.time, s.voltage, 0 * s.voltage])


def tektronix_old(path: Path, s: Signals) -> Path:
    settings = [
        f"Record Length,{len(s.time):e}",
        "Sample Interval,1.0e-03",
        "Trigger Point,1.2e+03",
        "Source,CH1",
        "Vertical Units,V",
        "Firmware Version,FV:v24.26",
    ]
    left = [*settings, *[","] * len(s.time)]
    rows = zip(left, s.time, s.voltage, strict=False)
    path.write_text("".join(f"{a},,{t:.9g},{u:.9g},\n" for a, t, u in rows))
    return path


def keysight(path: Path, s: Signals) -> Path:
    head = "x-axis,1,2\nsecond,Volt,Volt"
    return _csv(path, head, [s.time, s.voltage, 0 * s.voltage])


@dataclass(frozen=True)
class MotorLayout:
    """One layout.

    Attributes:
        name: name of the file.
        write: writer of the file.
        options: properties that the log does not tell.
        voltage: column of the voltage if the file only has this one, and the other signals are in
            a file beside it; else empty.
        tests: number of tests in the file.
        current: False if the file has no current.
    """

    name: str
    write: Callable[[Path, Signals], Path]
    options: MotorOptions = field(default_factory=MotorOptions)
    voltage: str = ""
    tests: int = 1
    current: bool = True


_POLES = MotorOptions(pole_pairs=7.0)
LAYOUTS = (
    MotorLayout("plain.csv", plain),
    MotorLayout("vesc.csv", vesc, _POLES),
    MotorLayout("vesc_six_step.csv", vesc_six_step, _POLES),
    MotorLayout("sysid.csv", sysid_csv, tests=4, current=False),
    MotorLayout("sysid.json", sysid_json, tests=4, current=False),
    MotorLayout("old.json", old_json, tests=4, current=False),
    MotorLayout("sysid.wpilog", wpilog, tests=4, current=False),
    MotorLayout("odrive.csv", odrive),
    MotorLayout("moteus.csv", moteus),
    MotorLayout("rigol.csv", rigol, voltage="CH1:V"),
    MotorLayout("rigol_memory.csv", rigol_memory, voltage="CH1:V"),
    MotorLayout("siglent.csv", siglent, voltage="CH1"),
    MotorLayout("siglent_one.csv", siglent_one, voltage="CH1"),
    MotorLayout("tektronix.csv", tektronix, voltage="CH1:V"),
    MotorLayout("tektronix_old.csv", tektronix_old, voltage="CH1"),
    MotorLayout("keysight.csv", keysight, voltage="1:V"),
)
