"""`slipid motor`: identify a motor on a bench from a single log file, without a config."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import Json, MaybeOut, Quiet, emit, flag, guarded, option
from slipid.support.progress import Reporter

Column = str | None
_column = partial(option, "NAME[:UNIT]")


@guarded
def motor(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Log, a CSV or Parquet file.")],
    time: Annotated[Column, _column("Column of the time, in s.")] = None,
    voltage: Annotated[Column, _column("Voltage across the motor, in V.")] = None,
    current: Annotated[Column, _column("Current in A; I:mA for others.")] = None,
    speed: Annotated[Column, _column("Speed of the shaft, in rad/s; w:rpm for others.")] = None,
    angle: Annotated[Column, _column("Angle of the shaft, in rad, for the speed.")] = None,
    duty: Annotated[Column, _column("Share of the bus voltage; d:% too.")] = None,
    bus: Annotated[Column, _column("Bus voltage, with --duty, in V.")] = None,
    unsigned: Annotated[bool, flag("--unsigned", "The current is a magnitude.")] = False,
    delimiter: Annotated[
        str | None, option("CHARACTER", "Text between cells; guessed by default.")
    ] = None,
    out: MaybeOut = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Identify a motor's resistance, back-EMF, friction and inertia from voltage, current, speed.

    Columns that are not named are guessed. Several motors: names by commas. The speed must be that
    of the motor shaft: no log shows that it was taken behind a gear. With --out it writes
    motor.json and a picture. Exit code 1 where the model does not explain the log.
    """
    from slipid.app.bench import read_motor_log
    from slipid.data.reading.motor_layout import given_columns
    from slipid.report.estimates import show_bench
    from slipid.support.files import write_json

    columns = {
        "time": time,
        "voltage": voltage,
        "current": current,
        "motor_speed": speed,
        "motor_angle": angle,
        "duty": duty,
        "bus_voltage": bus,
    }
    given = {c: given_columns(text, c) for c, text in columns.items() if text is not None}
    with Reporter(quiet=quiet) as report:
        report.stage("reading the log")
        task = read_motor_log(file, given, delimiter, not unsigned)
        fit = task.fit(report)
        content, written = fit.to_json(), ["motor.json"]
        if out is not None:
            from slipid.plots.bench import bench_plots

            report.stage("drawing")
            write_json(out / "motor.json", content)
            written += [path.name for path in bench_plots(fit, out)]
    emit(json, content, lambda page: show_bench(page, fit, task.columns_used), out, written)
    return 0 if fit.good else 1
