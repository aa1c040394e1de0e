"""Hostile files are refused with one sentence, before much memory is allocated."""

from __future__ import annotations

import io
import os
import pickle
import struct
import zipfile
from typing import Annotated

import numpy as np
import pytest
from pydantic import Field

from slipid.support.errors import LONGEST, DataError, shown
from slipid.support.files import read_arrays, read_bytes, read_json
from slipid.support.parsing import json_of, toml_of
from slipid.support.quantities import Positive
from slipid.support.toml_file import Section, checked

DEEP = "[" * 40 + "]" * 40


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('{"a": NaN}', "NaN is not a number"),
        ('{"a": [1, 1e999]}', r"a\[2\]: inf; expected a finite number$"),
        ('{"a": 1, "a": 2}', "the key 'a' occurs twice"),
        ('{"a": ' + "9" * 400 + "}", "^a: a whole number of 1329 bits; expected at most 64"),
        ('{"a": ' + "9" * 5000 + "}", "not valid JSON"),
        ('{"a": ' + DEEP + "}", "more than 32 levels"),
        ("[" * 100_000, "not valid JSON"),
        ("1e999", "the file: inf"),
        (b"\xff\xfe", "not valid JSON"),
    ],
)
def test_json_is_finite_short_and_flat(text, expected):
    with pytest.raises(ValueError, match=expected):
        json_of(text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a = nan", "^a: nan; expected a finite number"),
        ("[b]\nc = [1.0, -inf]", r"^b\.c\[2\]: -inf; expected a finite number"),
        ("a = 1e308", "a: 1e.308; expected a finite number, 0 or of size 1e-20 to 1e.20"),
        ("a = 1e-320", "a: 1e-320; expected"),
        ("a = " + "9" * 400, "a: a whole number of 1329 bits"),
        ("a = " + "9" * 5000, "not valid TOML"),
        ("a = " + DEEP, "more than 32 levels"),
        ("a = " + "[" * 20_000, "not valid TOML"),
        ("a." * 50 + "b = 1", "more than 32 levels"),
        ("a = ", "not valid TOML"),
    ],
)
def test_toml_is_finite_short_and_flat(text, expected):
    with pytest.raises(ValueError, match=expected):
        toml_of(text)


def test_ordinary_content_is_unchanged():
    assert json_of('{"a": [1, -0.5, null, true, "x"], "b": 1e-320}')["a"] == [
        1,
        -0.5,
        None,
        True,
        "x",
    ]
    assert toml_of("a = 0.0\nb = [true, 1979-05-27]")["b"][0] is True


def packed(**arrays) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def with_header(text: str, data: bytes = b"") -> bytes:
    """The npz file with an array whose header is a given text."""
    header = text.encode().ljust(117) + b"\n"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        raw = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data
        archive.writestr("a.npy", raw)
    return buffer.getvalue()


def changed(raw: bytes, at: int, value: int) -> bytes:
    """The npz file with another 16-bit number in its directory, so many bytes after its start."""
    place = raw.index(b"PK\x01\x02") + at
    return raw[:place] + struct.pack("<H", value) + raw[place + 2 :]


GOOD = packed(a=np.arange(3.0))
GIANT = "{'descr': '<f8', 'fortran_order': False, 'shape': (100000000000,)}"
HOSTILE = {
    "giant shape": (with_header(GIANT), "expected 800000000000 by its shape"),
    "giant number": (with_header(GIANT.replace("100000000000", "9" * 40)), "by its shape"),
    "negative shape": (with_header(GIANT.replace("100000000000", "-1")), "not a complete npz"),
    "objects": (
        with_header(GIANT.replace("<f8", "|O").replace("100000000000", "1"), b"0" * 8),
        "expected numbers or strings",
    ),
    "no header": (with_header("{"), "not a complete npz"),
    "large by its directory": (changed(GOOD, 26, 2**14), "expected at most 536870912"),
    "unknown compression": (changed(GOOD, 10, 77), "not a complete npz"),
    "encrypted": (changed(GOOD, 8, 1), "not a complete npz"),
    "patched": (changed(GOOD, 8, 32), "not a complete npz"),
    "later version": (changed(GOOD, 6, 255), "not a complete npz"),
    "no zip": (b"PK" * 50, "not a complete npz"),
    "cut": (GOOD[:-30], "not a complete npz"),
    "flipped": (GOOD[:60] + bytes([GOOD[60] ^ 255]) + GOOD[61:], "not a complete npz"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_arrays_are_refused_before_they_are_allocated(name, tmp_path):
    raw, expected = HOSTILE[name]
    path = tmp_path / "a.npz"
    path.write_bytes(raw)
    with pytest.raises(DataError, match=expected) as caught:
        read_arrays(path, "what was saved")
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).endswith("expected what was saved")


def test_arrays_come_back_as_they_were(tmp_path):
    kept = {
        "x": np.arange(6.0).reshape(2, 3),
        "y": np.asfortranarray(np.arange(6).reshape(3, 2)),
        "name": np.array("key"),
        "none": np.zeros((0, 4)),
    }
    path = tmp_path / "a.npz"
    path.write_bytes(packed(**kept))
    found = read_arrays(path, "arrays")
    assert set(found) == set(kept)
    for name, array in kept.items():
        np.testing.assert_array_equal(found[name], array, strict=True)
        assert found[name].flags.writeable


def test_only_regular_files_of_a_usual_size_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "large").write_bytes(b"0" * 101)
    for name, expected in (
        ("pipe", "a pipe or a device; save it to a file first"),
        (".", "a folder"),
        ("large", "101 bytes; expected a thing, at most 100 bytes"),
        ("none", "No such file"),
        ("x" * 300, "too long"),
    ):
        with pytest.raises(DataError, match=expected):
            read_bytes(tmp_path / name, "a thing", 100)
    with pytest.raises(DataError, match="a pipe or a device; save it to a file first"):
        read_json(tmp_path / "pipe", "a thing")


@pytest.mark.parametrize(
    "message",
    [
        "m" * 10_000,
        "a" + " b" * 5000,
        "\n".join(["key: 'x'; expected y"] * 300),
        "a\x1b[31m\0" * 200,
    ],
    ids=["word", "words", "lines", "control characters"],
)
def test_no_message_is_long_or_unprintable(message):
    shown = str(DataError(message))
    assert 60 < len(shown) <= LONGEST
    assert shown.startswith(message[:1])
    assert shown.replace("\n", "").isprintable()
    assert str(DataError(shown)) == shown


def test_a_long_message_keeps_what_is_short():
    message = str(DataError(f"c.toml: logs.glob '{'g' * 3000}'; expected a glob\nc.toml: other"))
    assert message.startswith("c.toml: logs.glob 'ggg")
    assert message.endswith("expected a glob\nc.toml: other")


def test_each_mistake_has_its_line():
    long = [f"c.toml: key{k}: {'v ' * 150}; expected a number" for k in range(25)]
    error = DataError(*long[:3])
    assert str(error).split("\n") == long[:3]
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    many = DataError(*long)
    assert str(many).split("\n") == [*long[:20], "... (5 more)"]
    assert str(pickle.loads(pickle.dumps(many))) == str(many)
    assert len(str(DataError("w " * 900, "b")).split("\n")[0]) == LONGEST


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (0, "a: x: 0; expected a number from 1e-12 to 1e+12"),
        ([1, 0], "a: x[2]: 0; expected a number from 1e-12 to 1e+12"),
        ([], "a: x: []; expected: list should have at least 1 item after validation, not 0"),
        ({}, "a: x: {}; expected a number from 1e-12 to 1e+12"),
    ],
)
def test_a_number_or_a_list_of_them_has_one_mistake(given, message):
    class OneOrMany(Section):
        x: Positive | Annotated[list[Positive], Field(min_length=1)]

    with pytest.raises(DataError) as caught:
        checked("a", {"x": given}, OneOrMany)
    assert str(caught.value) == message


def test_a_long_value_loses_its_middle():
    assert shown(list(range(9))) == "[0, 1, 2, 3, 4, 5, 6, 7, 8]"
    text = shown(list(range(10**5)))
    assert len(text) == 125
    assert text.startswith("[0, 1, 2,")
    assert text.endswith("99998, 99999]")
