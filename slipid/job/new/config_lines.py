"""Lines of a config that people read: keys with what they mean, and questions that are open."""

import json
from collections.abc import Iterable
from dataclasses import dataclass

ASKS = "# ? "
"""What the line of an open question begins with."""
_COLUMN = 38
"""Where comments begin, if the line leaves room."""
_WIDTH = 98
Value = str | bool | int | float | list[int] | list[float] | list[str] | list[list[int]] | object


@dataclass(frozen=True)
class ConfigLine:
    """One key of a config.

    Attributes:
        key: its name; value: as TOML.
        comment: what it means.
        question: what the reader is to fill in here; nothing where all is known.
        off: whether it is commented out.
    """

    key: str
    value: str
    comment: str = ""
    question: str = ""
    off: bool = False

    def text(self) -> str:
        """The line, below its question."""
        asked = _asked(self.question)
        line = f"{'# ' if self.off else ''}{self.key} = {self.value}"
        if not self.comment:
            return asked + line
        if len(line) < _COLUMN:
            line = line.ljust(_COLUMN - 1)
        elif len(line) + len(self.comment) + 3 > _WIDTH + 4:
            above = "".join(f"# {part}\n" for part in wrapped(self.comment, _WIDTH - 2))
            return asked + above + line
        return f"{asked}{line} # {self.comment}"


@dataclass(frozen=True)
class ConfigBlock:
    """A table of a config: its header, comments above it, its keys, comments at its end."""

    header: str
    lines: tuple[ConfigLine, ...] = ()
    above: tuple[str, ...] = ()
    below: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()

    def text(self) -> str:
        """Its part of the file."""
        out = [f"# {part}".rstrip() for text in self.above for part in wrapped(text, _WIDTH - 2)]
        out += [_asked(question).rstrip("\n") for question in self.questions]
        out += [self.header] if self.header else []
        out += [line.text() for line in self.lines]
        out += [f"# {part}".rstrip() for text in self.below for part in wrapped(text, _WIDTH - 2)]
        return "\n".join(out)

    @property
    def asked(self) -> tuple[str, ...]:
        """Every question in it."""
        lines = (f"{line.key}: {line.question}" for line in self.lines if line.question)
        return (*self.questions, *lines)


def toml(value: Value) -> str:
    """A plain value as inline TOML; whole floats as people write them."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml(one) for one in value) + "]"
    return json.dumps(value, ensure_ascii=False)


def _asked(question: str) -> str:
    """A question as comment lines, the first of which begins with `ASKS`."""
    if not question:
        return ""
    first, *others = wrapped(question, _WIDTH - len(ASKS))
    return "".join([f"{ASKS}{first}\n", *(f"#   {part}\n" for part in others)])


def wrapped(text: str, width: int) -> list[str]:
    """Text in lines of at most so many characters; line breaks and drawings stay."""
    out: list[str] = []
    for line in text.splitlines() or [""]:
        if len(line) <= width:
            out.append(line)
            continue
        here = ""
        for word in line.split(" "):
            if here and len(here) + 1 + len(word) > width:
                out.append(here)
                here = word
            else:
                here = f"{here} {word}" if here else word
        out.append(here)
    return out


def all_asked(blocks: Iterable[ConfigBlock]) -> tuple[str, ...]:
    """Every open question of a config, in its order."""
    return tuple(question for block in blocks for question in block.asked)
