"""Values that no number of a config, layout or map may have, put in the place of each number."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from slipid.support.errors import LONGEST, DataError

NONSENSE = (math.nan, math.inf, -math.inf, 1e308, -1e308, 10**400, 10**5000, "x", True, None, {})
Path = tuple[str | int, ...]


def numbers_in(content: Any, path: Path = ()) -> Iterator[Path]:
    """Yield the path of each number in nested tables and lists; truth values are no numbers."""
    inside = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in inside:
        if isinstance(value, dict | list):
            yield from numbers_in(value, (*path, key))
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield (*path, key)


def refuse_nonsense(content: Any, read: Callable[[Any], object], optional: set[str]) -> int:
    """Check that `read` names the key of each nonsensical number; return the count of numbers.

    Keys that are `optional` may be None.
    """
    read(copy.deepcopy(content))
    paths = list(numbers_in(content))
    for path in paths:
        key = [step for step in path if isinstance(step, str)][-1]
        for value in NONSENSE:
            if value is None and key in optional:
                continue
            changed = copy.deepcopy(content)
            here = changed
            for step in path[:-1]:
                here = here[step]
            here[path[-1]] = value
            with pytest.raises(DataError) as caught:
                read(changed)
            assert key in str(caught.value), (path, str(caught.value))
            assert max(map(len, str(caught.value).split("\n"))) <= LONGEST
    return len(paths)
