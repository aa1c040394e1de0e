"""Damage to the structure of JSON, TOML and YAML: hostile values at random places of a content."""

from __future__ import annotations

import json
import tomllib
from typing import Any

import numpy as np


class Raw(str):
    """Text that is written as it is, in place of a value that Python cannot hold or dump."""


HOSTILE: tuple[Any, ...] = (
    *(float("nan"), float("inf"), float("-inf"), -1, 0, 1, 2, -0.5, 1e308, -1e308, 1e-320, 1e18),
    *(2**31, 2**63, -(2**63), 10**29, Raw("1" + "0" * 400), Raw("9" * 5001), Raw("1e999")),
    *("", "x", "m" * 3000, "\0", "../../../x", "/nowhere/x", "10**10**10", "s**99", "nan", "1e400"),
    *("{stem}", "**", "[", "Ω\u202e", "\ud800" * 0 + "é" * 600, "a\nb", "%s", "{}"),
    *(True, False, None, [], {}, [[]], [None], {"x": 1}, ["x"] * 50, [0.0] * 2000, list(range(9))),
    *(Raw("[" * 400 + "]" * 400), Raw("[" * 20000 + "]" * 20000)),
)
"""Values that replace those of a content."""
_KEYS = ("", "x", "value", "0", "a.b", "é", "k" * 1000, "__class__", "\n")


def paths_of(content: Any, most: int = 4000) -> list[tuple[Any, ...]]:
    """Return the places of all values below the content itself, as the keys that lead to them."""
    found: list[tuple[Any, ...]] = []
    ahead: list[tuple[tuple[Any, ...], Any]] = [((), content)]
    while ahead and len(found) < most:
        path, value = ahead.pop()
        if isinstance(value, dict):
            below = list(value.items())
        elif isinstance(value, list):
            below = list(enumerate(value[:50]))
        else:
            continue
        found += [(*path, key) for key, _ in below]
        ahead += [((*path, key), one) for key, one in below]
    return found


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copied(one) for key, one in value.items()}
    return [_copied(one) for one in value] if isinstance(value, list) else value


def _picked(paths: list[tuple[Any, ...]], rng: np.random.Generator) -> tuple[Any, ...]:
    """Return a place; each depth is as likely as the others, so that the many leaves leave some."""
    depths = sorted({len(path) for path in paths})
    depth = depths[int(rng.integers(len(depths)))]
    some = [path for path in paths if len(path) == depth]
    return some[int(rng.integers(len(some)))]


def hurt(content: Any, rng: np.random.Generator) -> Any:
    """Return a content with one to three changes: values, keys, or items of lists."""
    out = _copied(content)
    for _ in range(1 + int(rng.integers(6)) // 4):
        paths = paths_of(out)
        if not paths:
            return HOSTILE[int(rng.integers(len(HOSTILE)))]
        path = _picked(paths, rng)
        parent = out
        for key in path[:-1]:
            parent = parent[key]
        _change(parent, path[-1], out, paths, rng)
    return out


def _change(
    parent: Any, key: Any, whole: Any, paths: list[tuple[Any, ...]], rng: np.random.Generator
) -> None:
    """Change one value of a table or list in place."""
    what, value = int(rng.integers(10)), parent[key]
    if what < 5:
        parent[key] = HOSTILE[int(rng.integers(len(HOSTILE)))]
    elif what == 5:
        del parent[key]
    elif what == 6:  # the value of another place, which is plausible but of the wrong kind
        other = whole
        for step in _picked(paths, rng):
            other = other[step]
        parent[key] = _copied(other)
    elif what == 7 and isinstance(parent, dict):
        parent[_KEYS[int(rng.integers(len(_KEYS)))]] = parent.pop(key)
    elif what == 7:
        parent.insert(key, _copied(value))
    elif what == 8 and isinstance(value, int | float) and not isinstance(value, bool):
        parent[key] = value * float(rng.choice([0.0, -1.0, 1e-6, 1e3, 1e9, 1e300]))
    elif isinstance(value, list) and value:
        parent[key] = value[: int(rng.integers(len(value)))] if what == 8 else [*value, *value]
    elif isinstance(value, str):
        parent[key] = value[:-1] if what == 8 else value * 2
    else:
        parent[key] = [value]


def read(suffix: str, raw: bytes) -> Any:
    """Return the content of a JSON, TOML or YAML file."""
    if suffix == ".toml":
        return tomllib.loads(raw.decode())
    if suffix == ".yaml":
        import yaml

        return yaml.safe_load(raw)
    return json.loads(raw)


def written(suffix: str, content: Any) -> bytes:
    """Return a content as a file; YAML is written in the form of JSON, which it includes."""
    if suffix == ".toml" and isinstance(content, dict):
        lines = (f"{json.dumps(str(k))} = {_text(v, suffix)}\n" for k, v in content.items())
        return "".join(lines).encode("utf-8", errors="replace")
    return _text(content, suffix).encode("utf-8", errors="replace")


def _text(value: Any, suffix: str) -> str:
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, dict):
        sign = " = " if suffix == ".toml" else ": "
        pairs = (f"{json.dumps(str(k))}{sign}{_text(v, suffix)}" for k, v in value.items())
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_text(one, suffix) for one in value) + "]"
    if isinstance(value, float) and not np.isfinite(value):
        names = {".toml": ("nan", "inf"), ".yaml": (".nan", ".inf")}
        word = names.get(suffix, ("NaN", "Infinity"))[int(not np.isnan(value))]
        return "-" * (value < 0) + word
    if value is None and suffix == ".toml":
        return '""'
    if suffix == ".toml" and not isinstance(value, str | bool | int | float):
        return str(value)  # dates and times
    return json.dumps(value)
