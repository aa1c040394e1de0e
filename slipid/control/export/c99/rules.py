"""How every primitive of JAX that a step uses becomes C.

Primitives that only move numbers need no rule of their own: they are asked, by JAX itself, where
the numbers of their result come from.
"""

from __future__ import annotations

from slipid.control.export.c99 import elementwise, moves, sums
from slipid.control.export.c99.elementwise import BINARY, UNARY, Rule
from slipid.control.export.c99.sums import REDUCED

RULES: dict[str, Rule] = {
    **{name: elementwise.unary(name) for name in UNARY},
    **{name: elementwise.binary(name) for name in BINARY},
    **{name: sums.reduced(name) for name in REDUCED},
    "argmin": sums.argmin,
    "convert_element_type": elementwise.converted,
    "dot_general": sums.dot,
    "dynamic_slice": moves.dynamic_slice,
    "gather": moves.gather,
    "integer_pow": elementwise.integer_pow,
    "scatter": moves.scatter,
    "scatter-add": moves.scattered("add", 0.0),
    "scatter-mul": moves.scattered("mul", 1.0),
    "select_n": elementwise.select,
}
"""By the name of the primitive."""
