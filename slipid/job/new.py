"""A config for a robot that nobody has described yet, with every key explained in place."""

from pathlib import Path

from slipid.job.config import parsed
from slipid.support.errors import DataError
from slipid.support.files import write_bytes

_TEMPLATE = """\
# slipid check {name} --data DIR
# slipid identify {name} --data DIR --out OUT
# Every number is SI or has its unit in the name of its key.

[robot]
drive = "{drive}"
{shape}
wheel_radius_m = {radius}
gear_ratio = {gear}                   # motor turns per wheel turn
mass_kg = {mass}                      # weigh it: friction scales with it

# Which column of your files holds what, in which unit (ms, rpm, deg, mm, tick, mA, % and so on).
# Take out what you do not log. To be fitted a run needs time, the wheels' motion and the pose;
# currents tell friction, voltages (or duty and bus_voltage) the motor's constants.
[layouts.mine]
delimiter = ","
names_row = 1                         # line of the column names, counted from 1
first_data_row = 2
ticks_per_revolution = {ticks}        # of the motor shaft
gear_ratio = {gear}
current_is_signed = true              # false where only magnitudes are logged

[layouts.mine.columns]
time = {{ column = "time", unit = "s" }}
wheel_ticks = {{ columns = [{ticks_columns}], unit = "tick" }}
current = {{ columns = [{current_columns}], unit = "A" }}
voltage = {{ columns = [{voltage_columns}], unit = "V" }}
pose_x = {{ column = "x", unit = "m" }}
pose_y = {{ column = "y", unit = "m" }}
pose_heading = {{ column = "heading", unit = "rad" }}
# the command tells runs apart: speed and heading
twist_command_x = {{ column = "command_x", unit = "m/s" }}
twist_command_y = {{ column = "command_y", unit = "m/s" }}
twist_command_yaw = {{ column = "command_yaw", unit = "rad/s" }}

# One section per set of logs.
[[logs]]
glob = "*/*.csv"                      # below --data
format = "mine"
surface = "folder"                    # the folder names the floor; or write a name here
load = "as_built"                     # one name per way the robot was loaded
# map = "maps/site.toml"              # instead of surface: a floor map, for runs that cross floors

# [weights.as_built]                  # what scales show under each wheel, if you weighed the robot
# kg = [3.1, 5.2, 3.2]
# std_kg = 0.05

# Patterns of parameter names. fixed = value; start = value; free = true or false; prior is Gaussian
# in the parameter's own unit. `slipid check` lists the names.
[parameters]
"camera.lag" = {{ prior = {{ mean = 0.0, std = 0.05 }} }}    # pose behind the encoders [s]
"camera.marker_yaw" = {{ free = true }}                    # marker's heading less the robot's [rad]
# from the motor's datasheet; without voltages they stay what is written here
"motor.resistance" = {{ prior = {{ mean = 1.0, std = 0.5 }} }}     # [ohm]
"motor.back_emf" = {{ prior = {{ mean = 0.05, std = 0.025 }} }}    # [V s/rad]
"""


_AZIMUTHS = "wheel_azimuths_deg = [60, 180, 300]   # of the centres; each drives 90 deg further"


def write_new(
    out: Path,
    drive: str,
    wheel_radius_m: float,
    base_m: float,
    gear_ratio: float,
    mass_kg: float,
    ticks_per_revolution: float,
    force: bool = False,
) -> None:
    """Write a config that reads.

    Args:
        drive: omni, mecanum or skid.
        base_m: distance of the wheels from the middle [m]; of mecanum and skid along both axes.
        gear_ratio: turns of the motor per turn of the wheel.
        ticks_per_revolution: of the encoder, per turn of the motor.
        force: replace the file if there is one.

    Raises:
        DataError: the file exists and shall not be replaced, or the answers make no robot.
    """
    if out.exists() and not force:
        raise DataError(f"{out}: exists already; expected a new file, or --force")
    if drive not in ("omni", "mecanum", "skid"):
        raise DataError(f"drive '{drive}'; expected one of omni, mecanum, skid")
    wheels, shape = 4, f"half_length_m = {base_m:g}\nhalf_width_m = {base_m:g}"
    if drive == "omni":
        wheels, shape = 3, f"{_AZIMUTHS}\nbase_radius_m = {base_m:g}"
    columns = {
        f"{what}_columns": ", ".join(f'"{what}_{k + 1}"' for k in range(wheels))
        for what in ("ticks", "current", "voltage")
    }
    text = _TEMPLATE.format(
        name=out.name,
        drive=drive,
        shape=shape,
        radius=f"{wheel_radius_m:g}",
        gear=f"{gear_ratio:g}",
        mass=f"{mass_kg:g}",
        ticks=f"{ticks_per_revolution:g}",
        **columns,
    )
    parsed(out, text)  # answers that make no robot overwrite nothing
    write_bytes(out, text.encode())
