"""What a key means: the line about it in the docstring of the class that declares it."""

import inspect
import re
from dataclasses import fields, is_dataclass
from functools import lru_cache

from pydantic import BaseModel

_STARTS = re.compile(r"^([a-z_0-9]+(?:, [a-z_0-9]+)*): (.+)$")
_MORE = re.compile(r"; (?=[a-z_0-9]+: )")


@lru_cache(maxsize=64)
def meanings(kind: type) -> dict[str, str]:
    """Meaning of each key of a model or a dataclass, also those that it inherits."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if one.__doc__ and (issubclass(one, BaseModel) or is_dataclass(one)):
            found |= _attributes(one.__doc__)
    return found


def meaning(kind: type, key: str) -> str:
    """Meaning of one key; KeyError where its class does not say it."""
    found = meanings(kind)
    if key not in found:
        raise KeyError(f"the docstring of {kind.__name__} has no attribute line for '{key}'")
    return found[key]


def in_short(kind: type, key: str) -> str:
    """The same up to its first full stop, colon or semicolon, for a comment beside a value."""
    return re.split(r"[.:;](?= |$)", meaning(kind, key))[0]


def purpose(kind: type) -> str:
    """What the class says of itself before it comes to its attributes."""
    text = inspect.cleandoc(kind.__doc__ or "").split("\n\nAttributes:")[0]
    return " ".join(text.split())


def keys(kind: type) -> tuple[str, ...]:
    """Keys in the order of declaration, as a config spells them."""
    if issubclass(kind, BaseModel):
        return tuple(field.alias or name for name, field in kind.model_fields.items())
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()


def _attributes(docstring: str) -> dict[str, str]:
    """Lines `key: text` below `Attributes:`, continued by lines that stand further in."""
    _, _, block = inspect.cleandoc(docstring).partition("Attributes:\n")
    found: dict[str, str] = {}
    names: tuple[str, ...] = ()
    for line in block.splitlines():
        if line.strip() and not line.startswith("    "):
            break
        started = _STARTS.match(line[4:])
        if started:
            names = tuple(started[1].split(", "))
            text = started[2]
        elif line.strip() and names:
            text = f"{found[names[0]]} {line.strip()}"
        else:
            continue
        found |= dict.fromkeys(names, text)
    return {name: part for key, text in found.items() for name, part in _several(key, text)}


def _several(key: str, text: str) -> list[tuple[str, str]]:
    """Attributes that share a line: `mean: its centre; std: its width`."""
    first, *others = _MORE.split(text)
    pairs = [(key, first)]
    for other in others:
        name, _, said = other.partition(": ")
        pairs.append((name, said))
    return pairs
