"""Wrong shapes and types are refused wherever a function is defined, late as checks are made."""

from __future__ import annotations

import importlib
import os
import sys
import threading

import jaxtyping
import numpy as np
import pytest

from slipid.data.write import robotino2022_csv
from tests.helpers.checked import check_types_of

SOURCE = """
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


def pair(a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return a if a.sum() else b[:1]


def adder(offset):
    def add(a: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return a + offset

    return add


def again(count: int, depth: int = 0) -> int:
    return again(count - 1, depth + 1) if count else depth


def scaled(a: Float[np.ndarray, "n"], by: float = 2.0) -> Float[np.ndarray, "n"]:
    return by * a


@dataclass(frozen=True)
class One:
    x: int


@dataclass(frozen=True)
class Other:
    x: str

    @classmethod
    def of(cls, x: str) -> Other:
        return cls(x)

    @staticmethod
    def length(x: str) -> int:
        return len(x)

    @property
    def short(self) -> str:
        return 1 if self.x == "wrong" else self.x
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    (folder / "made_to_check.py").write_text(SOURCE, encoding="utf-8")
    before = list(sys.meta_path)
    sys.path.insert(0, str(folder))
    try:
        check_types_of("made_to_check")
        yield importlib.import_module("made_to_check")
    finally:
        sys.path.remove(str(folder))
        sys.meta_path[:] = before
        sys.modules.pop("made_to_check", None)


ONES = np.ones(3)
REFUSED = pytest.raises(jaxtyping.TypeCheckError)


def test_axes_of_one_name_are_of_one_length(made):
    assert made.pair(ONES, ONES) is ONES
    with REFUSED:
        made.pair(ONES, np.ones(2))
    with REFUSED:
        made.pair(0.0 * ONES, ONES)
    with REFUSED:
        made.pair(3.0, ONES)


def test_functions_with_equal_code_are_checked_equally_and_stay_themselves(made):
    one, other, wrong = made.adder(1.0), made.adder(2.0), made.adder(np.ones((2, 1)))
    np.testing.assert_array_equal(one(ONES), 2.0)
    np.testing.assert_array_equal(other(ONES), 3.0)
    np.testing.assert_array_equal(one(ONES), 2.0)
    for refused in (lambda: one(1.0), lambda: other("a"), lambda: wrong(ONES)):
        with REFUSED:
            refused()


def test_a_function_that_calls_itself_ends(made):
    assert made.again(20) == 20
    with REFUSED:
        made.again(1.0)


def test_defaults_are_kept(made):
    np.testing.assert_array_equal(made.scaled(ONES), 2.0)
    with REFUSED:
        made.scaled(ONES, "a")


def test_dataclasses_with_equal_code_are_distinguished(made):
    assert (made.One(1).x, made.Other("a").x) == (1, "a")
    with REFUSED:
        made.One("a")
    with REFUSED:
        made.Other(1)


def test_methods_of_classes_and_properties_are_checked(made):
    assert made.Other.of("a").short == "a"
    assert made.Other.length("abc") == 3
    for wrong in (lambda: made.Other.of(1), lambda: made.Other.length(1)):
        with REFUSED:
            wrong()
    with REFUSED:
        _ = made.Other("wrong").short


def test_threads_do_not_take_each_others_functions(made):
    found = {}

    def work(k):
        add = made.adder(float(k))
        found[k] = {float(add(ONES)[0]) for _ in range(200)}

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {k: {k + 1.0} for k in range(4)}


@pytest.mark.skipif(os.environ.get("SLIPID_CHECK_TYPES") == "0", reason="types are not checked")
def test_slipid_is_checked():
    with pytest.raises(jaxtyping.TypeCheckError, match="robotino2022_csv"):
        robotino2022_csv("no log", 16.0, 2000)
