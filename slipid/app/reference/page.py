"""The reference of configs as Markdown text, made from the models that check configs."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from slipid.app import config as c
from slipid.app.new.config_lines import drawing
from slipid.app.reference.keys import ConfigKey, ParameterRow, keys_of, parameter_rows, purpose
from slipid.data.reading.bag.layout import BagLayout, RunRule, TopicChannel
from slipid.data.reading.layout import CHANNELS, PER_WHEEL, SEVERAL, Channel, Layout
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.units import KNOWN
from slipid.support.errors import DataError, did_you_mean

_DRIVES: tuple[tuple[type[c.Wheels], str, dict[str, object]], ...] = (
    (c.OmniDrive, "omni", {"base_radius_m": 0.2, "wheel_azimuths_deg": [60, 180, 300]}),
    (c.FourWheelDrive, "mecanum", {"half_length_m": 0.2, "half_width_m": 0.15}),
    (
        c.FourWheelDrive,
        "skid",
        {"half_length_m": 0.2, "half_width_m": 0.15, "drives": [[1, 3], [2, 4]]},
    ),
    (c.DifferentialDrive, "differential", {"track_m": 0.3}),
)
"""Model, name and sizes of an example robot for each type of drive that the reference draws."""
_SECTIONS: tuple[tuple[str, type], ...] = (
    ("[[logs]]", c.LogsSection),
    ("[camera]", c.CameraSection),
    ('[parameters] "PATTERN"', c.ParameterSection),
    ("prior, of a parameter", c.PriorSection),
    ("[weights.LOAD]", c.WeightsSection),
    ("[fit]", c.FitSection),
    ("[validate]", c.ValidateSection),
    ("[selftest]", c.SelftestSection),
)


@dataclass(frozen=True)
class Chapter:
    """Part of the reference that can be requested by its name.

    Attributes:
        name: name of the part.
        text: function that returns the text, for the robot of a config if one is given.
    """

    name: str
    text: Callable[["c.Config | None"], str]


def reference(what: str | None = None, config: "c.Config | None" = None) -> str:
    """Return the reference of configs as Markdown.

    Args:
        what: name of the part to return; None for the whole reference.
        config: config whose robot's parameters are listed, or None.

    Raises:
        DataError: no part has this name.
    """
    names = [chapter.name for chapter in CHAPTERS]
    if what is None:
        parts = [_INTRODUCTION, *(chapter.text(config) for chapter in CHAPTERS)]
        return "\n\n".join(parts) + "\n"
    found = [chapter for chapter in CHAPTERS if chapter.name == what]
    if not found:
        raise DataError(f"'{what}'{did_you_mean(what, names)}; expected one of {', '.join(names)}")
    return found[0].text(config) + "\n"


_INTRODUCTION = """\
# Keys of a config

This page is written by `slipid reference` from the code that checks a config; do not edit it.
`slipid new` writes a config with the keys that your robot needs, and `configs/` has a config for
each public data set."""


def _config(_: object) -> str:
    parts = ["## Config", _table_of_keys(keys_of(c.ConfigContent))]
    for header, kind in _SECTIONS:
        parts += [f"### `{header}`", purpose(kind), _table_of_keys(keys_of(kind))]
    return "\n\n".join(parts)


_FRAMES = """\
## Drives

The frame of the robot has x ahead, y to the left and yaw counter-clockwise, seen from above, in
metres and radians; its origin is the middle of the wheels. Columns of the logs, and every list with
a value per wheel, are in the order of the wheels. If wheels share a motor, columns are in the
order of `drives`. A wheel with a positive speed pushes the robot in the direction of its arrow."""


def _drives(_: object) -> str:
    parts = [_FRAMES, "### Keys of every drive", _table_of_keys(keys_of(c.WheeledDrive))]
    common = {key.name for key in keys_of(c.WheeledDrive)}
    for kind, name, sizes in _DRIVES:
        robot = kind.model_validate({"drive": name, "wheel_radius_m": 0.05, **sizes})
        own = [key for key in keys_of(kind) if key.name not in common and key.name != "drive"]
        picture = f"```text\n{drawing(c.geometry(robot))}\n```"
        parts += [f'### `drive = "{name}"`', purpose(kind), _table_of_keys(own), picture]
    own = [key for key in keys_of(c.GeneralDrive) if key.name not in common and key.name != "drive"]
    parts += ['### `drive = "general"`', purpose(c.GeneralDrive), _table_of_keys(own)]
    own = [key for key in keys_of(c.BenchMotors) if key.name != "drive"]
    parts += ['### `drive = "motor"`', purpose(c.BenchMotors), _table_of_keys(own)]
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


def _bags() -> list[str]:
    alike = tuple(key.name for key in keys_of(Layout))
    return [
        _BAGS,
        _table_of_keys(keys_of(BagLayout, hidden=(*alike, "topics"))),
        "#### A channel of `topics`",
        purpose(TopicChannel),
        _table_of_keys(keys_of(TopicChannel)),
        "#### `runs`",
        purpose(RunRule),
        _table_of_keys(keys_of(RunRule)),
    ]


def _layouts(_: object) -> str:
    keys = keys_of(Layout, hidden=("channels",))
    parts = [_LAYOUT, _table_of_keys(keys), "### A channel of `columns`", purpose(Channel)]
    return "\n\n".join([*parts, _table_of_keys(keys_of(Channel)), *_bags()])


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
    columns: list[str] = [
        "parameter",
        "numbers",
        "symbol",
        "unit",
        "meaning",
        "start",
        "default prior",
    ]
    columns += ["in this config"] if config else []
    return f"{head}\n\n{_table(columns, [_cells(row, config is not None) for row in rows])}"


def _cells(row: ParameterRow, of_config: bool) -> tuple[str, ...]:
    cells = (
        *(f"`{row.path}`", str(row.size), row.symbol, _unit_text(row.unit)),
        *(row.means, row.start, row.prior),
    )
    return (*cells, row.here) if of_config else cells


def _unit_text(unit: str) -> str:
    return "1" if unit in ("1", "") else unit


def _table_of_keys(keys: Iterable[ConfigKey]) -> str:
    rows = [(f"`{key.name}`", key.kind, key.default, key.means) for key in keys]
    return _table(("key", "value", "default", "meaning"), rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    return "\n".join([line(head), "|" + "---|" * len(head), *(line(row) for row in rows)])


CHAPTERS = (
    Chapter("config", _config),
    Chapter("drives", _drives),
    Chapter("layouts", _layouts),
    Chapter("channels", _channels),
    Chapter("units", _units),
    Chapter("presets", _presets),
    Chapter("parameters", _parameters),
)
