"""robot.json: written whole or not at all, and read with one clear sentence for all that is wrong.

`robot.schema.json` beside this package describes the file for other programs.
"""

import json
import re
from dataclasses import asdict
from pathlib import Path

from slipid.control.robot_file.check import check
from slipid.control.robot_file.record import UNITS, RobotRecord, checksum
from slipid.control.robot_file.typed import typed
from slipid.support.errors import DataError
from slipid.support.files import write_bytes

SCHEMA = "slipid.robot/1"
ANEW = "copy it again, or write it anew with `slipid identify`"


def write_robot(path: Path, record: RobotRecord) -> None:
    """Write a robot.

    Raises:
        DataError: nothing can be written there.
    """
    content: dict[str, object] = {"schema": SCHEMA, "units": UNITS, **asdict(record)}
    content["numbers"] = record.numbers
    content["checksum"] = checksum(content)
    write_bytes(path, (_text(content) + "\n").encode())


def read_robot(path: Path) -> RobotRecord:
    """Read a robot.

    Raises:
        DataError: absent, no robot, of a newer version, damaged or changed; says which.
    """
    content = _content(path)
    said = content.pop("checksum", None)
    now = checksum(content)
    content.pop("schema")
    if content.pop("units", None) != UNITS:
        raise DataError(f"{path}: other units than {SCHEMA} has; {ANEW}")
    numbers = content.pop("numbers", None)
    try:
        record = typed(RobotRecord, content)
        check(record)
    except ValueError as error:
        raise DataError(f"{path}: {error}; {ANEW}") from error
    if said != now or numbers != record.numbers:
        raise DataError(
            f"{path}: the content does not match its checksum, so it was changed or damaged after "
            f"it was written; {ANEW}"
        )
    return record


def _content(path: Path) -> dict[str, object]:
    """What the file says, of a version that can be read."""
    try:
        content = json.loads(
            path.read_bytes().decode("utf-8"), parse_constant=_refused, object_pairs_hook=_once
        )
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f"{path}: {reason}; expected what `slipid identify` writes") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: no valid JSON ({error}); {ANEW}") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if not (isinstance(schema, str) and re.fullmatch(r"slipid\.robot/[1-9][0-9]{0,8}", schema)):
        raise DataError(
            f"{path}: no robot of slipid (its schema is not {SCHEMA}); expected the robot.json "
            "that `slipid identify` writes"
        )
    if schema != SCHEMA:
        raise DataError(
            f"{path}: written by a newer slipid as {schema}, this one reads {SCHEMA}; update slipid"
        )
    return dict(content)


def _refused(word: str) -> None:
    raise ValueError(f"{word} is no number")


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    content = dict(pairs)
    if len(content) < len(pairs):
        raise ValueError("a key stands there twice")
    return content


def _text(value: object, indent: str = "") -> str:
    """JSON with objects over several lines and everything without objects on one."""
    inner = indent + " "
    if isinstance(value, dict) and value:
        rows = [f"{inner}{json.dumps(k)}: {_text(v, inner)}" for k, v in value.items()]
        return "{\n" + ",\n".join(rows) + f"\n{indent}}}"
    if isinstance(value, list | tuple) and any(isinstance(v, dict) for v in value):
        return "[\n" + ",\n".join(inner + _text(v, inner) for v in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False)
