"""The config with which `slipid identify` fits the logs of a simulation."""

import numpy as np

from slipid.data.write import OPTIONAL, own_columns
from slipid.testsite.simulate.config import Plan

_IDENTIFY = """\
# Identifies the robot of these logs:
#   slipid identify robot.toml --data logs --out result
# They were made by slipid simulate; the truth lies in truth/, which nothing reads that fits.

[robot]
drive = "omni"
wheel_azimuths_deg = {azimuths}
base_radius_m = {base}
wheel_radius_m = {radius}
gear_ratio = {gear}
mass_kg = {mass}

[layouts.testsite]
ticks_per_revolution = {ticks}
gear_ratio = {gear}
current_is_signed = {signed}

[layouts.testsite.columns]
{columns}
{sets}
[parameters]
"camera.scale" = {{ prior = {{ mean = {scale}, std = 0.002 }} }}      # measured, with an error
"camera.lag" = {{ prior = {{ mean = 0.05, std = 0.02 }} }}
"camera.marker_yaw" = {{ free = true }}
"motor.resistance" = {{ start = 11.0, prior = {{ mean = 8.0, std = 4.0 }} }}
"motor.back_emf" = {{ start = 0.0257, prior = {{ mean = 0.04, std = 0.02 }} }}
"""


def identify_config(plan: Plan) -> str:
    """Text of a config for `slipid identify` that fits the logs in slipid's own columns."""
    machine, sensors = plan.site.machine, plan.site.sensors
    measured = 0.0015 * float(np.random.default_rng([plan.content.seed, 2]).normal())
    more = [channel for channel in OPTIONAL if getattr(sensors, channel)]
    columns = own_columns(len(machine.wheel_azimuths_deg), more)
    one = {(run.load, run.surface) for _, run in plan.runs if run.surface is not None}
    where = [(load, surface, 'surface = "folder"') for load, surface in sorted(one)]
    where += [(load, name, f'map = "maps/{name}.toml"') for load, name in _mapped(plan)]
    sets = "".join(
        f'\n[[logs]]\nglob = "{load}/{name}/*.csv"\nformat = "testsite"\n{floor}\nload = "{load}"\n'
        for load, name, floor in where
    )
    return _IDENTIFY.format(
        azimuths=list(machine.wheel_azimuths_deg),
        base=machine.base_radius_m,
        radius=machine.wheel_radius_m,
        gear=machine.gear_ratio,
        mass=machine.mass_kg,
        ticks=plan.site.motor.ticks_per_revolution,
        signed=str(sensors.current_is_signed).lower(),
        columns="\n".join(f"{name} = {_inline(c)}" for name, c in columns.items()),
        sets=sets,
        scale=round(sensors.camera_scale * (1 + measured), 4),
    )


def _mapped(plan: Plan) -> list[tuple[str, str]]:
    """Load and map of runs over several floors, where runs on one floor tell of each and the load.

    Whatever steered them, the camera logs their poses in the frame of the map.
    """
    one = [run for _, run in plan.runs if run.surface is not None]
    floors, loads = {run.surface for run in one}, {run.load for run in one}
    pairs = {(run.load, name.split("/")[1]) for name, run in plan.runs if run.surface is None}
    return sorted(
        (load, name)
        for load, name in pairs
        if load in loads and set(plan.maps[name].surfaces) <= floors
    )


def _inline(value: object) -> str:
    """A value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_inline(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_inline(v) for v in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def can_identify(plan: Plan) -> bool:
    """Whether there are logs in slipid's own columns that a fit can use."""
    return "slipid" in plan.content.formats and any(r.surface is not None for _, r in plan.runs)
