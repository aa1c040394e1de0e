"""Text of the documentation that is made from the code: commands, functions, schemas, results.

A page asks for a part by an empty fenced block with the language `{generated} NAME`; `conf.py`
replaces the block by Markdown when Sphinx reads the page. Nothing here is typed by hand.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
BLOCK = re.compile(r"^```\{generated\} (?P<name>[a-z_]+)(?: (?P<argument>\w+))?\n```$", re.M)


def expand(text: str) -> str:
    """Return the text of a page in which every generated block is replaced by its content.

    Raises:
        KeyError: a block has an unknown name.
    """

    def content(found: re.Match[str]) -> str:
        argument = found["argument"]
        return PARTS[found["name"]](*(() if argument is None else (argument,))).rstrip()

    return BLOCK.sub(content, text)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(re.sub(r"\s+", " ", c).replace("|", "\\|") for c in cells) + " |"

    return "\n".join([line(head), "|" + "---|" * len(head), *map(line, rows)])


def commands() -> str:
    """Return a section for each command, with its help, arguments and options."""
    import typer

    from slipid.cli.main import app

    every = typer.main.get_group(app).commands
    panels: dict[str, list[str]] = {}
    for name, command in every.items():
        panel = getattr(command, "rich_help_panel", None)
        panels.setdefault(panel if isinstance(panel, str) else "", []).append(name)
    level = "##" if list(panels) == [""] else "###"
    parts: list[str] = []
    for panel, names in panels.items():
        parts += [f"## {panel}"] if level == "###" else []
        for name in names:
            parts += [f"(command-{name})=", f"{level} `slipid {name}`"]
            parts += _command(name, every[name])
    return "\n\n".join(parts)


def _command(name: str, command: Any) -> list[str]:
    """Return the paragraphs about one command."""
    given = [p for p in command.params if not p.hidden]
    arguments = [p for p in given if p.param_type_name == "argument"]
    options = [p for p in given if p.param_type_name == "option" and p.name != "help"]
    words = [p.metavar or p.name.upper() for p in arguments]
    words += [f"{_flags(p)} {p.metavar}" for p in options if p.required]
    open_options = " [OPTIONS]" if any(not p.required for p in options) else ""
    parts = [f"```text\nslipid {' '.join([name, *words])}{open_options}\n```"]
    parts += _help(command.help or "")
    if arguments:
        rows = [(f"`{p.metavar or p.name}`", p.help or "") for p in arguments]
        parts.append(table(("argument", "meaning"), rows))
    if options:
        rows = [(f"`{_flags(p)}`", _value(p), p.help or "", _default(p)) for p in options]
        parts.append(table(("option", "value", "meaning", "default"), rows))
    return parts


def _help(text: str) -> list[str]:
    """Return the paragraphs of a help text; indented ones are shown as they stand."""
    parts = []
    for paragraph in re.split(r"\n\s*\n", text.replace("\b\n", "").strip("\n")):
        lines = paragraph.splitlines()
        if all(line.startswith("  ") for line in lines):
            parts.append("```text\n" + "\n".join(line.strip() for line in lines) + "\n```")
        else:
            parts.append(re.sub(r"\s+", " ", paragraph).strip())
    return parts


def _flags(option: Any) -> str:
    return ", ".join([*option.opts, *option.secondary_opts])


def _value(option: Any) -> str:
    if option.is_flag:
        return ""
    return f"`{option.metavar or 'VALUE'}`"


def _default(option: Any) -> str:
    if option.required:
        return "required"
    default = option.default
    if default is None or option.is_flag or callable(default) or default in ((), []):
        return ""
    return f"`{default}`"


GROUPS: dict[str, tuple[str, ...]] = {
    "Robots and runs": ("Robot", "layout", "read_runs", "plot_runs", "check"),
    "Reference robots": ("reference_robots", "reference_robot"),
    "Calibration and fit": ("calibrate", "fit", "Prior", "Fit", "Profile", "Validation"),
    "Uncertainty": ("Plan", "Posterior"),
    "On the robot": (
        *("DeployedRobot", "Estimator", "Measurement", "Controller"),
        *("FloorLookup", "floor_map", "export", "drive"),
    ),
    "Simulated runs and physics": ("simulate_runs", "steady_motion", "wheel_curve"),
    "Camera": ("OverheadCamera", "LoneMarker", "track"),
    "Set-up and errors": ("setup_jax", "DataError"),
}
"""Public names of `slipid` in the order in which the reference explains them."""


def functions() -> str:
    """Return directives that document every public name of `slipid`, in groups."""
    import slipid

    lines: list[str] = []
    for title, names in GROUPS.items():
        lines += [f"## {title}", ""]
        for name in names:
            if isinstance(getattr(slipid, name), type):
                lines += ["```{eval-rst}", f".. autoclass:: slipid.{name}", "   :members:", "```"]
            else:
                lines += ["```{eval-rst}", f".. autofunction:: slipid.{name}", "```"]
            lines.append("")
    return "\n".join(lines)


def schemas(folder: Path | None = None) -> str:
    """Return a table of the files whose content has a JSON schema, and write the schemas.

    Args:
        folder: folder to write the schemas to; nothing is written if it is None.
    """
    rows = []
    for name, (schema, meaning) in _schemas().items():
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"{name}.schema.json"
            path.write_text(json.dumps(schema, indent=1) + "\n", encoding="utf-8")
        link = f"{{download}}`{name}.schema.json <../_static/schemas/{name}.schema.json>`"
        rows.append((meaning, link))
    return table(("file", "JSON schema"), rows)


def _schemas() -> dict[str, tuple[Mapping[str, Any], str]]:
    """Return the schemas of files that people and other programs write or read."""
    from slipid.app.config import ConfigContent
    from slipid.camera.floor.region import Palette
    from slipid.camera.overhead import CameraFile
    from slipid.data.floor_map import PatchedFile, PicturedFile
    from slipid.robot import robot_file

    robot = Path(robot_file.__file__).with_name("robot.schema.json")
    return {
        "config": (ConfigContent.model_json_schema(), "config of a robot (TOML)"),
        "robot": (json.loads(robot.read_text(encoding="utf-8")), "`robot.json`"),
        "camera": (CameraFile.model_json_schema(), "`camera.json` of `slipid calibrate`"),
        "palette": (Palette.model_json_schema(), "`palette.toml` of `slipid map` (TOML)"),
        "patches": (PatchedFile.model_json_schema(), "floor map made of patches (TOML)"),
        "picture": (PicturedFile.model_json_schema(), "floor map made of a picture (TOML)"),
    }


def result(name: str) -> str:
    """Return the table of a results file, and how it was measured.

    Args:
        name: name of the file in `docs/results`, without `.json`.
    """
    content = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    rows = [
        [f"**{cell}**" if k in content["bold_rows"] and cell else cell for cell in map(text, row)]
        for k, row in enumerate(content["rows"])
    ]
    made = (
        f"Measured on {content['date']} with slipid {content['slipid']} on {content['machine']}, by"
    )
    return "\n\n".join(
        [
            f"Values: {content['values']}.",
            table(content["columns"], rows),
            f"{made}\n\n```console\n{content['command']}\n```",
        ]
    )


def text(cell: float | str | Sequence[float] | None) -> str:
    """Return a cell of a results file as text; a list is a value with its interval."""
    if cell is None:
        return ""
    if isinstance(cell, list):
        return "{} [{}, {}]".format(*cell)
    return str(cell)


PARTS: dict[str, Callable[..., str]] = {
    "commands": commands,
    "functions": functions,
    "result": result,
    "schemas": schemas,
}
"""Function that writes each part, by the name that a page gives."""
