"""Names that tools give to the columns of a motor's log, with their channels and units.

A log of such a tool has many columns whose names would be misread, so only the listed ones are
used. A motor with field-oriented control is read along its q axis, as if it had brushes.
"""

import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

from slipid.data.reading.column_names import ColumnMeaning

_PATH = r"(?:.*[./ ])?"
"""Path before a name, such as `odrv0.axis0.motor.foc.`."""


@dataclass(frozen=True)
class MotorTool:
    """Columns that a tool writes.

    Attributes:
        columns: channel and unit of the columns whose names match a pattern, in any case.
        needs: channels that a log of the tool has.
    """

    columns: Mapping[str, tuple[str, str]]
    needs: frozenset[str]

    def meanings(self, names: Sequence[str]) -> dict[str, ColumnMeaning]:
        """Return the meaning of each column of the tool; empty if the log is not one of it."""
        found = {}
        for name in names:
            for pattern, (channel, unit) in self.columns.items():
                if re.fullmatch(pattern, name, re.IGNORECASE):
                    found[name] = ColumnMeaning(channel, "", unit)
                    break
        return found if self.needs <= {one.channel for one in found.values()} else {}


_VESC = {"ms_today": ("time", "ms"), "erpm": ("motor_speed", "rpm")}
_VESC_Q = {"q_axis_voltage": ("voltage", "V"), "q_axis_current": ("current", "A")}
_VESC_DUTY = {
    "duty_cycle": ("duty", "1"),
    "input_voltage": ("bus_voltage", "V"),
    "current_motor": ("current", "A"),
}
TOOLS = (
    # VESC tool; without field-oriented control its columns of the axes are zero
    MotorTool(_VESC | _VESC_Q, frozenset({"time", "motor_speed", "voltage", "current"})),
    MotorTool(_VESC | _VESC_DUTY, frozenset({"time", "motor_speed", "duty", "current"})),
    # odrivetool
    MotorTool(
        {
            f"{_PATH}(vel_estimate|pos_vel_mapper[.]vel)": ("motor_speed", "rev/s"),
            f"{_PATH}(pos_estimate|pos_vel_mapper[.]pos_rel)": ("motor_angle", "rev"),
            f"{_PATH}iq_measured": ("current", "A"),
            f"{_PATH}(v_current_control_integral_q|vq(_measured|_setpoint)?)": ("voltage", "V"),
            f"{_PATH}vbus(_voltage)?": ("bus_voltage", "V"),
        },
        frozenset({"motor_speed", "current"}),
    ),
    # moteus_tool and tview, whose voltage is that of the bus
    MotorTool(
        {
            f"{_PATH}velocity": ("motor_speed", "rev/s"),
            f"{_PATH}position": ("motor_angle", "rev"),
            f"{_PATH}(q_current|(i_)?q_a)": ("current", "A"),
            f"{_PATH}(q_v|voltage_dq_q|q_voltage)": ("voltage", "V"),
            f"{_PATH}(voltage|bus_v)": ("bus_voltage", "V"),
        },
        frozenset({"motor_speed", "current"}),
    ),
    # SysIdRoutineLog of WPILib
    MotorTool(
        {
            f"{_PATH}voltage-.+": ("voltage", "V"),
            f"{_PATH}velocity-.+": ("motor_speed", "rev/s"),
            f"{_PATH}position-.+": ("motor_angle", "rev"),
            f"{_PATH}current-.+": ("current", "A"),
        },
        frozenset({"voltage", "motor_speed"}),
    ),
)


def tool_meanings(names: Sequence[str], without: Set[str]) -> dict[str, ColumnMeaning]:
    """Return the meanings of the columns of a known tool's log; empty if no tool is known.

    Tools are left out that need one of the channels `without`, which the user replaced.
    """
    tools = (tool for tool in TOOLS if not tool.needs & without)
    return next((found for tool in tools if (found := tool.meanings(names))), {})
