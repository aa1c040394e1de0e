"""Names of floors and load set-ups that ROS parameters, C++ and files can have."""

import re
from collections.abc import Sequence

_WORDS = """
alignas alignof and asm auto bitand bitor bool break case catch char class compl concept const
constexpr continue decltype default delete do double else enum explicit export extern false float
for friend goto if inline int long mutable namespace new not operator or private protected public
register requires return short signed sizeof static struct switch template this throw true try
typedef typeid typename union unsigned using virtual void volatile while xor
"""
_TAKEN = frozenset(_WORDS.split())
"""Words of C++, which the fields of a generated struct cannot have."""


def identifiers(labels: Sequence[str], kind: str) -> tuple[str, ...]:
    """A name of small letters, digits and single underscores for each label, no two alike.

    They differ without underscores, too: generated structs are called after them in that way.
    `kind` stands before a label that is no name by itself.
    """
    names: list[str] = []
    for label in labels:
        plain = re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")
        name = (
            plain if plain[:1].isalpha() and plain not in _TAKEN else f"{kind}_{plain}".strip("_")
        )
        count, first = 2, name
        while _bare(name) in map(_bare, names):
            name, count = f"{first}_v{count}", count + 1
        names.append(name)
    return tuple(names)


def _bare(name: str) -> str:
    return name.replace("_", "")
