"""YAML files of ROS 2 parameters, and input files for `generate_parameter_library`.

From an input file `generate_parameter_library` generates C++ code that declares the parameters. The
file is a tree of names; its leaves contain type, default, description, whether the parameter is
read-only, and the names and arguments of validators.
"""

import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from slipid.exports.text import COMMENT_WIDTH, one_line, wrapped

Scalar = bool | int | float | str
Value = bool | float | str | tuple[bool, ...] | tuple[float, ...] | tuple[str, ...]
_TYPES = {bool: "bool", float: "double", str: "string"}


@dataclass(frozen=True)
class Check:
    """A validator of `generate_parameter_library`: its name and arguments."""

    name: str
    arguments: tuple[Scalar | tuple[str, ...], ...]


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node.

    Attributes:
        name: name, with points between the names of groups and the parameter's own name.
        value: value; it is the default value in input for `generate_parameter_library`.
        about: description in one paragraph; empty if the previous parameter's description covers
            this parameter as well.
        checks: validators of the value.
        read_only: True if the parameter can be set only when the node starts.
        per_line: number of array elements per line; 0 for as many as a line can hold.
    """

    name: str
    value: Value
    about: str = ""
    checks: tuple[Check, ...] = ()
    read_only: bool = True
    per_line: int = 0

    @property
    def type(self) -> str:
        """Type of the parameter in the terms of `generate_parameter_library`."""
        several = isinstance(self.value, tuple)
        one = self.value[0] if isinstance(self.value, tuple) else self.value
        return _TYPES[type(one)] + "_array" * several


_Leaf = Callable[[Parameter, str, str], Iterator[str]]
"""Function that yields the lines of a parameter, given its name without groups and an indent."""


def scalar(value: Scalar) -> str:
    """Return a value as text from which YAML 1.1 and 1.2 restore it exactly.

    A float gets a point, and its exponent a sign: YAML 1.1 would read `1e-05` and `1.0e6` as text.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, str):
        return '"' + "".join(map(_letter, value)) + '"'
    digits, mark, exponent = repr(float(value)).partition("e")
    if not mark:
        return digits
    return (digits if "." in digits else f"{digits}.0") + mark + exponent


def comment(lines: Sequence[str]) -> list[str]:
    """Return lines of text as YAML comments."""
    return [f"# {line}".rstrip() for line in lines]


def nodes(parts: Sequence[tuple[str, Sequence[Parameter]]]) -> list[str]:
    """Return the lines of a ROS parameter file for nodes, each given by its name and parameters.

    Parameters of the same group must follow one another.
    """
    lines: list[str] = []
    for node, parameters in parts:
        lines += ["", f"{node}:", "  ros__parameters:", *_nested(parameters, 2, _valued)]
    return lines


def declaration(namespace: str, parameters: Sequence[Parameter]) -> list[str]:
    """Return input lines for `generate_parameter_library`, with the values as defaults."""
    return ["", f"{namespace}:", *_nested(parameters, 1, _declared)]


def _nested(parameters: Sequence[Parameter], depth: int, leaf: _Leaf) -> Iterator[str]:
    before: list[str] = []
    for parameter in parameters:
        *groups, name = parameter.name.split(".")
        same = 0
        while same < min(len(groups), len(before)) and groups[same] == before[same]:
            same += 1
        for k in range(same, len(groups)):
            yield "  " * (depth + k) + f"{groups[k]}:"
        before = groups
        yield from leaf(parameter, name, "  " * (depth + len(groups)))


def _valued(parameter: Parameter, name: str, indent: str) -> Iterator[str]:
    width = COMMENT_WIDTH - len(indent)
    if parameter.about:
        yield from (f"{indent}# {line}" for line in wrapped(parameter.about, width))
    yield from _key(parameter, name, indent)


def _declared(parameter: Parameter, name: str, indent: str) -> Iterator[str]:
    yield f"{indent}{name}:"
    inner = indent + "  "
    yield f"{inner}type: {parameter.type}"
    yield from _key(parameter, "default_value", inner)
    yield f"{inner}description: {scalar(one_line(parameter.about))}"
    yield f"{inner}read_only: {scalar(parameter.read_only)}"
    if parameter.checks:
        yield f"{inner}validation:"
    for check in parameter.checks:
        arguments = ", ".join(
            f"[{', '.join(map(scalar, x))}]" if isinstance(x, tuple) else scalar(x)
            for x in check.arguments
        )
        yield f"{inner}  {check.name}: [{arguments}]"


def _key(parameter: Parameter, name: str, indent: str) -> Iterator[str]:
    """Yield the lines with a parameter's name and value; a long array takes several lines."""
    value = parameter.value
    if not isinstance(value, tuple):
        yield f"{indent}{name}: {scalar(value)}"
        return
    words, count = [scalar(x) for x in value], parameter.per_line
    if count:
        lines = [", ".join(words[k : k + count]) for k in range(0, len(words), count)]
        lines = [line + "," * (k + 1 < len(lines)) for k, line in enumerate(lines)]
    elif any(isinstance(x, str) for x in value):
        lines = [", ".join(words)]
    else:
        lines = textwrap.wrap(", ".join(words), COMMENT_WIDTH - len(indent))
    if len(lines) == 1:
        yield f"{indent}{name}: [{lines[0]}]"
        return
    yield f"{indent}{name}: ["
    yield from (f"{indent}  {line}" for line in lines)
    yield f"{indent}]"


def _letter(c: str) -> str:
    if c in '"\\':
        return f"\\{c}"
    return c if c.isprintable() else f"\\U{ord(c):08x}"
