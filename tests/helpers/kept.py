"""Cases of which some stay in the suite and the rest is nightly."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def kept(cases: Iterable[Any], of_suite: Collection[Any]) -> list[Any]:
    """The cases, those not named marked nightly."""
    return [
        case if case in of_suite else pytest.param(case, marks=pytest.mark.nightly)
        for case in cases
    ]
