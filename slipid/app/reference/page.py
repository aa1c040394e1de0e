"""The reference of configs as Markdown text, made from the models that check configs."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from slipid.app import config as c
from slipid.app.new.config_lines import drawing
from slipid.app.reference.keys import ConfigKey, keys_of, parameter_rows, purpose
from slipid.data.reading.bag.layout import BagLayout, RunRule, TopicChannel
from slipid.data.reading.layout import CHANNELS, PER_WHEEL, SEVERAL, Channel, Layout
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.units import KNOWN
from slipid.support.errors import DataError, did_you_mean

_BOX = {"half_length_m": 0.2, "half_width_m": 0.15}
_DRIVES: tuple[tuple[type[Any], str, dict[str, object] | None], ...] = (
    (c.OmniDrive, "omni", {"base_radius_m": 0.2, "wheel_azimuths_deg": [60, 180, 300]}),
    (c.FourWheelDrive, "mecanum", {**_BOX}),
    (c.FourWheelDrive, "skid", {**_BOX, "drives": [[1, 3], [2, 4]]}),
    (c.DifferentialDrive, "differential", {"track_m": 0.3}),
    (c.SteeredDrive, "steered", {"wheelbase_m": 0.3}),
    (c.GeneralDrive, "general", None),
    (c.BenchMotors, "motor", None),
)
"""Model and name of each type of drive, and sizes of an example robot if one is drawn."""
_SECTIONS: tuple[tuple[str, type], ...] = (
    ("[robot.limits]", c.LimitsSection),
    ("[robot.sensors]", c.SensorsSection),
    ("[robot.actuators]", c.ActuatorsSection),
    ("[[logs]]", c.LogsSection),
    ("[camera]", c.CameraSection),
    ('[parameters] "PATTERN"', c.ParameterSection),
    ("prior, of a parameter", c.PriorSection),
    ("[weights.LOAD]", c.WeightsSection),
    ("[fit]", c.FitSection),
    ("[validate]", c.ValidateSection),
    ("[selftest]", c.SelftestSection),
)


def reference(what: str | None = None, config: "c.Config | None" = None) -> str:
    """Return the reference of configs as Markdown.

    Args:
        what: name of the part to return; None for the whole reference.
        config: config whose robot's parameters are listed; None for a robot with three omni wheels.

    Raises:
        DataError: no part has this name.
    """
    if what is None:
        return "\n\n".join([_INTRODUCTION, *(text(config) for text in CHAPTERS.values())]) + "\n"
    if what not in CHAPTERS:
        expected = f"expected one of {', '.join(CHAPTERS)}"
        raise DataError(f"'{what}'{did_you_mean(what, CHAPTERS)}; {expected}")
    return CHAPTERS[what](config) + "\n"


_INTRODUCTION = """\
# Keys of a config

This page is written by `slipid reference` from the code that checks a config; do not edit it.
`slipid new` writes a config with the keys that your robot needs, and `configs/` has a config for
each public data set."""


def _config(_: object) -> str:
    parts = ["## Config", _table_of_keys(keys_of(c.ConfigContent))]
    for header, kind in _SECTIONS:
        parts += [f"### `{header}`", *_explained(kind)]
    return "\n\n".join(parts)


_FRAMES = """\
## Drives

The frame of the robot has x ahead, y to the left and yaw counter-clockwise, seen from above, in
metres and radians; its origin is the middle of the wheels. Columns of the logs, and every list with
a value per wheel, are in the order of the wheels. If wheels share a motor, columns are in the
order of `drives`. A wheel with a positive speed pushes the robot in the direction of its arrow."""


def _drives(_: object) -> str:
    parts = [_FRAMES, "### Keys of every drive", _table_of_keys(keys_of(c.WheeledDrive))]
    common = ("drive", *(key.name for key in keys_of(c.WheeledDrive)))
    for kind, name, sizes in _DRIVES:
        own = _table_of_keys(keys_of(kind, hidden=common))
        parts += [f'### `drive = "{name}"`', purpose(kind), own]
        if sizes is not None:
            robot = kind.model_validate({"drive": name, "wheel_radius_m": 0.05, **sizes})
            parts.append(f"```text\n{drawing(c.geometry(robot))}\n```")
    return "\n\n".join(parts)


_LAYOUT = """\
## Layouts

`[layouts.NAME]` describes the columns of one kind of log file; `[[logs]]` refers to it by
`format = "NAME"`. A layout may start from a preset (`format = "PRESET"`), which its other keys
change. `[layouts.NAME.columns]` has a line for each channel,
`CHANNEL = { column = "name", unit = "deg" }`, or `CHANNEL = false` to remove a channel of the
preset. `[layouts.NAME.beside."FILE"]` is the layout of an additional file that lies in the same
folder as the log file of a run."""


_BAGS = """\
### Bags

A layout with `kind = "bag"` describes ROS bags (rosbag1, rosbag2, MCAP). `[layouts.NAME.topics]`
has a line for each channel, `CHANNEL = { topic = "/name" }`; the channels `pose` and
`twist_command` stand for all three components in one message. The keys about encoders, currents
and jumps are those of the table above."""


def _layouts(_: object) -> str:
    alike = tuple(key.name for key in keys_of(Layout))
    parts = [
        *(_LAYOUT, _table_of_keys(keys_of(Layout, hidden=("channels",)))),
        *("### A channel of `columns`", *_explained(Channel)),
        *(_BAGS, _table_of_keys(keys_of(BagLayout, hidden=(*alike, "topics")))),
        *("#### A channel of `topics`", *_explained(TopicChannel)),
        *("#### `runs`", *_explained(RunRule)),
    ]
    return "\n\n".join(parts)


def _explained(kind: type) -> tuple[str, str]:
    """Return the purpose of a model, and the table of its keys."""
    return purpose(kind), _table_of_keys(keys_of(kind))


def _channels(_: object) -> str:
    rows = [(f"`{name}`", _unit_text(unit), _columns(name)) for name, unit in CHANNELS.items()]
    head = (
        "## Channels\n\nQuantities that columns can contain, and the units to which they are "
        "converted."
    )
    return f"{head}\n\n{_table(('channel', 'unit', 'columns'), rows)}"


def _columns(channel: str) -> str:
    if channel in SEVERAL:
        return "four: x, y, z, w"
    if channel == "time":
        return "one, or two: seconds and nanoseconds"
    return "one per wheel, or per motor" if channel in PER_WHEEL else "one"


def _units(_: object) -> str:
    known = ", ".join(f"`{unit}`" for unit in KNOWN)
    return f"""\
## Units

{known}

Products, quotients and prefixes of these are understood as well (`mm/s`, `kN*m`). Angles have
a dimension, so that `Hz` cannot be converted to `rad/s`. `pixel` needs `metres_per_pixel`."""


def _presets(_: object) -> str:
    rows = [
        (f"`{name}`", ", ".join(layout.channels), ", ".join(map(str, layout.columns[:4])) + " ...")
        for name, layout in PRESETS.items()
    ]
    head = "## Presets\n\nLayouts of published logs, which `format` can name."
    return f"{head}\n\n{_table(('preset', 'channels', 'first columns'), rows)}"


def _parameters(config: "c.Config | None") -> str:
    rows = parameter_rows(config)
    whose = f"the robot of {config.path.name}" if config else "a robot with three omni wheels"
    head = f"""\
## Parameters

Parameters of {whose}. `FLOOR` and `SESSION` stand for names in
the logs. In `[parameters]` a pattern such as `"surface.*.creep"` applies to every parameter that
it matches."""
    columns = ("parameter", "numbers", "symbol", "unit", "meaning", "start", "default prior")
    cells = [
        (f"`{r.path}`", str(r.size), r.symbol, _unit_text(r.unit), r.means, r.start, r.prior)
        for r in rows
    ]
    if config is None:
        return f"{head}\n\n{_table(columns, cells)}"
    here = [(*row, r.here) for row, r in zip(cells, rows, strict=True)]
    return f"{head}\n\n{_table((*columns, 'in this config'), here)}"


def _unit_text(unit: str) -> str:
    return "1" if unit in ("1", "") else unit


def _table_of_keys(keys: Iterable[ConfigKey]) -> str:
    rows = [(f"`{key.name}`", key.kind, key.default, key.means) for key in keys]
    return _table(("key", "value", "default", "meaning"), rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    return "\n".join([line(head), "|" + "---|" * len(head), *(line(row) for row in rows)])


CHAPTERS: dict[str, Callable[["c.Config | None"], str]] = {
    "config": _config,
    "drives": _drives,
    "layouts": _layouts,
    "channels": _channels,
    "units": _units,
    "presets": _presets,
    "parameters": _parameters,
}
"""Function that returns the text of each chapter, for the robot of a config if one is given."""
