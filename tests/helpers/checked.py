"""Checks of shapes and types that are made when a function is first called, not when it is defined.

jaxtyping's import hook makes two checking functions for each function of slipid, and for those that
are defined inside others at every call of these. Most functions are never called by the process
that imports them, and those inside others are the same code again and again.
"""

from __future__ import annotations

import functools
import inspect
import threading
from collections.abc import Callable
from dataclasses import is_dataclass
from types import CodeType, FunctionType
from typing import Any, Self

import jaxtyping

_eager = jaxtyping.jaxtyped
_made: dict[int, tuple[CodeType, Callable]] = {}
"""Checks by the identity of the code, which is kept: code of two dataclasses may be equal."""


class _Calls(threading.local):
    """Functions whose checked call has begun, the innermost last."""

    def __init__(self) -> None:
        self.stack: list[Callable] = []


_calls = _Calls()


def _checks(fn: FunctionType, typechecker: Callable) -> Callable:
    """The checks of a function, around whichever function of its code is called."""
    calls = _calls

    def called(*args: Any, **kwargs: Any) -> Any:
        return calls.stack[-1](*args, **kwargs)

    # annotations are words that are looked up where the function was defined
    there = FunctionType(called.__code__, fn.__globals__, fn.__name__, None, called.__closure__)
    functools.wraps(fn)(there)
    if fn.__annotations__.get("return") is Self:
        # beartype knows what it is where it decorates the class, not where it decorates a method
        del there.__annotations__["return"]
        there.__signature__ = inspect.signature(fn).replace(
            return_annotation=inspect.Signature.empty
        )
    return _eager(there, typechecker=typechecker)


def _shared(fn: FunctionType) -> bool:
    """Whether every function of this code has the same checks."""
    words = all(isinstance(said, str) for said in fn.__annotations__.values())
    return words and not fn.__defaults__ and not fn.__kwdefaults__


def _lazy(fn: FunctionType, typechecker: Callable) -> Callable:
    checked: Callable | None = None

    @functools.wraps(fn)
    def checking(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal checked
        if checked is None:
            code = fn.__code__
            if _shared(fn):
                if id(code) not in _made:
                    _made[id(code)] = code, _checks(fn, typechecker)
                _, checked = _made[id(code)]
            else:
                checked = _checks(fn, typechecker)
        stack = _calls.stack
        stack.append(fn)
        try:
            return checked(*args, **kwargs)
        finally:
            stack.pop()

    return checking


def _is_lazy(fn: Any) -> bool:
    return isinstance(fn, FunctionType) and fn.__globals__ is globals()


def _jaxtyped(fn: Any = None, *, typechecker: Callable) -> Any:
    if fn is None:
        return functools.partial(_jaxtyped, typechecker=typechecker)
    if inspect.isclass(fn):
        if is_dataclass(fn) and isinstance(fn.__init__, FunctionType) and not _is_lazy(fn.__init__):
            fn.__init__ = _lazy(fn.__init__, typechecker)
        return fn
    if isinstance(fn, classmethod | staticmethod):
        return type(fn)(_jaxtyped(fn.__func__, typechecker=typechecker))
    if isinstance(fn, property):
        parts = (fn.fget, fn.fset, fn.fdel)
        return property(*(p and _jaxtyped(p, typechecker=typechecker) for p in parts))
    if isinstance(fn, FunctionType):
        return _lazy(fn, typechecker)
    return _eager(fn, typechecker=typechecker)


def check_types_of(package: str) -> None:
    """Check what functions and dataclasses of a package are given and return; before its import."""
    jaxtyping.jaxtyped = _jaxtyped
    jaxtyping.install_import_hook(package, "beartype.beartype")
