"""Units of log columns: their conversion to SI units, with a check of the dimension."""

import re
from contextlib import suppress
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from slipid.support.errors import did_you_mean

if TYPE_CHECKING:
    import pint

# The registry defines its own units so that angle is a dimension. If an angle were a pure number,
# as in SI, "Hz" would silently convert to rad/s, and a duty cycle to an angle.
_PREFIXES = (
    "nano- = 1e-9 = n-",
    "micro- = 1e-6 = u- = µ-",
    "milli- = 1e-3 = m-",
    "centi- = 1e-2 = c-",
    "kilo- = 1e3 = k-",
)
_UNITS = (
    "meter = [length] = m = metre",
    "second = [time] = s = sec",
    "ampere = [current] = A = amp",
    "volt = [voltage] = V",
    "newton = [force] = N",
    "radian = [angle] = rad",
    "tick = [tick] = _ = count = pulse",
    "pixel = [pixel] = px = pix",
    "inch = 0.0254 * meter = in",
    "foot = 0.3048 * meter = ft",
    "minute = 60 * second = min",
    "hour = 3600 * second = h",
    "degree = 3.141592653589793 / 180 * radian = deg",
    "revolution = 6.283185307179586 * radian = rev = turn = rot",
    "rpm = revolution / minute",
    "fraction = []",
    "percent = 0.01 * fraction = %",
)
_ALIASES = {"%": "percent", "°": "degree", "°/s": "degree/s", "1": "fraction", "": "fraction"}
KNOWN = (
    *("s", "ms", "us", "ns", "min", "m", "mm", "cm", "inch", "rad", "deg", "rev", "rad/s", "deg/s"),
    *("rpm", "rev/s", "m/s", "mm/s", "A", "mA", "V", "mV", "tick", "pixel", "percent", "1", "N*m"),
)
_FACTOR = r"(?:[^\W\d_]+|%|°|1)(?:(?:\*\*|\^)-?\d)?"
_GRAMMAR = re.compile(rf"{_FACTOR}(?:(?: ?[*/·] ?| ){_FACTOR}){{0,5}}")
"""Up to six names, each perhaps to the power of one digit, in products and quotients. Pint gets no
other text, since it computes what it reads: 10**10**10 would take hours."""


@lru_cache(maxsize=1)
def _registry() -> "pint.UnitRegistry[Any]":
    """Return pint's registry with the units above."""
    # Pint is imported here because its import is slow and most commands read no log.
    import pint

    registry: pint.UnitRegistry[Any] = pint.UnitRegistry(None)
    for definition in (*_PREFIXES, *_UNITS):
        registry.define(definition)
    return registry


@lru_cache(maxsize=256)
def factor(unit: str, target: str) -> float:
    """Return the factor that converts values in a unit ("rpm", "mm/s", "%") to a target unit.

    Raises:
        ValueError: the unit is unknown, or has another dimension than the target.
    """
    text = _ALIASES.get(unit.strip(), unit.strip())
    known = f"{did_you_mean(unit[:40], KNOWN)} (known: {', '.join(KNOWN)})"
    if not _GRAMMAR.fullmatch(text):
        raise ValueError(f"unknown unit '{unit}'{known}")
    registry = _registry()
    wanted = registry.parse_units(_ALIASES.get(target, target))
    try:
        given = registry.parse_units(text)
    except Exception as error:  # pint raises many types of errors, even from tokenize
        raise ValueError(f"unknown unit '{unit}'{known}") from error
    if given.dimensionality != wanted.dimensionality:
        raise ValueError(f"unit '{unit}' cannot be converted to {target}")
    return float(registry.Quantity(1.0, given).to(wanted).magnitude)


def converts(unit: str, target: str) -> bool:
    """Return whether a unit is known and has the same dimension as the target."""
    with suppress(ValueError):
        return factor(unit, target) > 0
    return False


def same_unit(one: str, other: str) -> bool:
    """Return whether two strings mean the same unit, such as "pix" and "pixel".

    The result is False if one of them is not a known unit.
    """
    with suppress(ValueError):
        return abs(factor(one, other) - 1.0) < 1e-9
    return False
