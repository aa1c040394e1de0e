"""Parsing of JSON, TOML and npz content from outside, within limits that no real file reaches."""

import json
import math
import tomllib
from collections.abc import Sequence
from io import BytesIO
from typing import Any, Literal
from zipfile import ZipFile, ZipInfo

import numpy as np

from slipid.support.content import Content

MOST_LEVELS = 32
"""Largest number of lists and tables inside each other."""
MOST_ARRAY_BYTES = 512 * 2**20
"""Largest sum of the sizes of the arrays of a file [bytes]."""
_LARGE, _SMALL = 1e20, 1e-20
Step = str | int
"""Step of a location in a file: the key of a table, or the index in a list."""


def json_of(text: str | bytes) -> Any:
    """Return the value of a JSON text, which is UTF-8 if given as bytes.

    Raises:
        ValueError: not JSON, a number that is not finite or has too many digits, a key that occurs
            twice, or more levels than `MOST_LEVELS`.
    """
    try:
        text = text if isinstance(text, str) else text.decode("utf-8")
        content = json.loads(text, parse_constant=_refused, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not valid JSON ({error})") from error
    _check(content, 0.0, math.inf)
    return content


def toml_of(text: str) -> Content:
    """Return the content of a TOML text.

    Raises:
        ValueError: not TOML, a number that is not finite, above 1e20 or, but for 0, below 1e-20 in
            size, a whole number of more than 64 bits, or more levels than `MOST_LEVELS`.
    """
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not valid TOML ({error})") from error
    _check(content, _SMALL, _LARGE)
    return content


def _refused(word: str) -> None:
    raise ValueError(f"{word} is not a number")


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [key for key, _ in pairs]
        raise ValueError(f"the key '{next(k for k in names if names.count(k) > 1)}' occurs twice")
    return content


def _check(content: object, least: float, most: float) -> None:
    """Raise `ValueError`, naming the key, for too many levels or a number out of bounds."""
    stack: list[tuple[tuple[Step, ...], object]] = [((), content)]
    while stack:
        steps, value = stack.pop()
        if len(steps) >= MOST_LEVELS:
            raise ValueError(f"{spelled(steps)}: more than {MOST_LEVELS} levels")
        for step, x in value.items() if isinstance(value, dict) else enumerate(_listed(value)):
            if isinstance(x, dict | list):
                stack.append(((*steps, step), x))
            elif isinstance(x, int | float) and (problem := _problem(x, least, most)):
                where = spelled((*steps, step) if isinstance(value, dict | list) else steps)
                raise ValueError(f"{where or 'the file'}: {problem}")


def _listed(value: object) -> list[object]:
    return value if isinstance(value, list) else [value]


def _problem(x: int | float, least: float, most: float) -> str | None:
    """Return the value of a number that is out of bounds, and the expected one; None if within."""
    if isinstance(x, int):
        # `repr` of a whole number of over 4300 digits raises
        found = f"a whole number of {x.bit_length()} bits; expected at most 64 bits"
        return found if abs(x) >= 2**64 else None
    if math.isfinite(x) and (x == 0 or least <= abs(x) <= most):
        return None
    bounds = f", 0 or of size {least} to {most}" if least else ""
    return f"{x}; expected a finite number{bounds}"


def spelled(steps: Sequence[Step]) -> str:
    """Return a location as a text such as `a.b[2]`, in which items of lists are counted from 1."""
    out = ""
    for step in steps:
        if isinstance(step, int):
            out += f"[{step + 1}]"
        else:
            plain = step.replace("_", "").replace("-", "").isalnum()
            out += f".{step}" if plain else f'."{step}"'
    return out.removeprefix(".")


def arrays_of(packed: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by name, from its bytes.

    Sizes are checked before memory is allocated.

    Raises:
        ValueError: the file is not a complete npz file of plain arrays, or its arrays are larger
            than `MOST_ARRAY_BYTES`.
    """
    try:
        with ZipFile(BytesIO(packed)) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > MOST_ARRAY_BYTES:
                raise ValueError(f"arrays of {size} bytes; expected at most {MOST_ARRAY_BYTES}")
            return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
    # zipfile, zlib and numpy raise errors of a dozen types for damaged files
    except Exception as error:
        raise ValueError(f"not a complete npz file ({error})") from error


def _array(archive: ZipFile, member: ZipInfo) -> np.ndarray:
    raw = archive.read(member)
    stream = BytesIO(raw)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{member.filename}: format of another version; expected 1.0")
    shape, by_column, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject or not dtype.itemsize:
        raise ValueError(f"{member.filename}: values of type {dtype}; expected numbers or strings")
    given, stated = len(raw) - stream.tell(), math.prod(shape) * dtype.itemsize
    if given != stated or min(shape, default=0) < 0:
        raise ValueError(f"{member.filename}: {given} bytes; expected {stated} by its shape")
    order: Literal["F", "C"] = "F" if by_column else "C"
    return np.ndarray(shape, dtype, raw, stream.tell(), order=order).copy(order)
