"""`slipid motor`: identify a motor on a bench from a single log file, without a config."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import Json, MaybeOut, Quiet, can_draw, emit, flag, guarded, option
from slipid.cli.identify import PRIORS
from slipid.support.folder import locked
from slipid.support.progress import Reporter
from slipid.support.quantities import GearRatio, PolePairs, TicksPerTurn

NAMES = ("motor.json", "report.html", "bench.png", "bench_*.png", "motor_feedforward.*")
"""Names of all files that the command writes."""
Column = str | None
_column = partial(option, "[FILE::]NAME[:UNIT]")


@guarded
def motor(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Log file (CSV, Parquet, WPILOG, SysId JSON).")
    ],
    time: Annotated[Column, _column("Column with the time, in s.")] = None,
    voltage: Annotated[Column, _column("Column with the voltage across the motor, in V.")] = None,
    current: Annotated[
        Column, _column("Column with the current, in A, or in a unit that you add, as in I:mA.")
    ] = None,
    speed: Annotated[
        Column, _column("Column with the shaft speed, in rad/s, or in an added unit, as in w:rpm.")
    ] = None,
    angle: Annotated[
        Column, _column("Column with the shaft angle, in rad, instead of the speed.")
    ] = None,
    duty: Annotated[
        Column, _column("Column with the duty cycle, 0 to 1, instead of the voltage; in %, as d:%.")
    ] = None,
    bus: Annotated[Column, _column("Column with the bus voltage, in V; with --duty.")] = None,
    pole_pairs: Annotated[
        float | None,
        option(
            "NUMBER", "Pole pairs of the motor, if the speed is electrical (erpm).", kind=PolePairs
        ),
    ] = None,
    gear: Annotated[
        float,
        option(
            "RATIO", "Motor turns per turn of the sensor of speed, angle or pulses.", kind=GearRatio
        ),
    ] = 1.0,
    pulses: Annotated[
        Column,
        _column("Column with a tachometer's count or level; with a unit of time: pulse times."),
    ] = None,
    pulses_per_revolution: Annotated[
        float | None,
        option("NUMBER", "Pulses per turn of the tachometer; with --pulses.", kind=TicksPerTurn),
    ] = None,
    ignore: Annotated[
        list[str] | None, option("NAME", "Column that is not guessed to be a channel; repeatable.")
    ] = None,
    unsigned: Annotated[
        bool, flag("--unsigned", "The logged current is a magnitude without sign.")
    ] = False,
    between: Annotated[
        str | None,
        option("FORM", "Voltage between rows: held, straight or jumps; by default the likeliest."),
    ] = None,
    delimiter: Annotated[
        str | None, option("CHARACTER", "Character between cells; guessed by default.")
    ] = None,
    out: MaybeOut = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Identify a motor on a bench from its log: resistance, back-EMF, friction and inertia.

    The log needs the voltage, current and speed of the motor; without the current, it gives the
    feed-forward gains alone. Columns that are not given are found by their names; a given channel
    replaces its alternatives, and :-UNIT reverses a sign. Channels may be in other files with other
    rates but the same clock. For several motors, separate their columns by commas. Speeds are those
    of the motor shaft unless --gear is given; a gear cannot be detected. With --out, the command
    writes report.html, motor.json, a picture, and feed-forward gains as a header in C and as ROS 2
    parameters. The exit code is 1 if the model does not explain the log.
    """
    from slipid.app.bench import bench_content, read_motor_log
    from slipid.data.reading.motor_layout import MotorOptions, given_columns
    from slipid.report.estimates import show_bench
    from slipid.support.errors import DataError, shown
    from slipid.support.files import write_json

    if delimiter is not None and len(delimiter) != 1:
        raise DataError(
            f"--delimiter {shown(delimiter)}: {len(delimiter)} characters; expected one, such as ;"
        )
    columns = {
        "time": time,
        "voltage": voltage,
        "current": current,
        "motor_speed": speed,
        "motor_angle": angle,
        "duty": duty,
        "bus_voltage": bus,
        "pulses": pulses,
    }
    options = MotorOptions(
        signed=not unsigned,
        pole_pairs=pole_pairs,
        gear_ratio=gear,
        pulses_per_revolution=pulses_per_revolution,
        ignored=frozenset(ignore or ()),
    )
    given = {c: given_columns(text, c) for c, text in columns.items() if text is not None}
    with Reporter(quiet=quiet) as report, locked(out, "motor", *NAMES):
        report.stage("reading the log")
        task = read_motor_log(file, given, delimiter, options, between)
        fit = task.fit(report)
        content, written = bench_content(fit), ["motor.json"]
        if out is not None:
            from slipid.exports.feedforward import write_gains
            from slipid.infer.feedforward import bench_feedforwards
            from slipid.report.html.bench_page import bench_page
            from slipid.report.html.page import REPORT, try_page

            write_json(out / "motor.json", content)
            written += write_gains(out, bench_feedforwards(fit))
            if can_draw(report):
                from slipid.plots.bench import bench_plots

                written += [path.name for path in bench_plots(fit, out)]
            page = bench_page(fit, file.name, task.columns_used)
            written[:0] = try_page(page, out / REPORT, report)
    used = task.columns_used
    emit(json, content, lambda page: show_bench(page, fit, used), [PRIORS], out, written)
    return 0 if fit.good else 1
