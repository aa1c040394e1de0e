"""How much JAX traces and compiles while some code runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import jax

_COMPILES = "/jax/core/compile/"
"""Events of tracing a function, of lowering it and of compiling it begin so."""
_counting: list[list[str]] = []


def _listen(event: str, duration: float, **_: object) -> None:
    if event.startswith(_COMPILES):
        for found in _counting:
            found.append(event.removeprefix(_COMPILES))


jax.monitoring.register_event_duration_secs_listener(_listen)


@contextmanager
def compilations() -> Iterator[list[str]]:
    """List that gets the name of every event of a compilation within the context."""
    found: list[str] = []
    _counting.append(found)
    try:
        yield found
    finally:
        _counting[:] = [other for other in _counting if other is not found]
