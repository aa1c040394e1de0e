"""Damage to zip archives and to the arrays of npz files: what a checksum of bytes does not show."""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache

import numpy as np

Members = dict[str, bytes]
_DTYPES = (
    "<f4",
    "<i8",
    "<u1",
    "|b1",
    "<c16",
    "<U3",
    "|S5",
    "<M8[s]",
    ">f8",
    "|V9",
    "|O",
    "<U99999",
)
_SHAPES = (
    *("(100000000000,)", "(1000000000,)", "(-1,)", "(0,)", "()", f"({10**30},)", "(3, 0)"),
    *("(2, 2, 2, 2, 2)", "[3]", "None", "(1.5,)", "(" + "1," * 70 + ")", "(134217729,)"),
)


def _header(dtype: str, shape: str, fortran: str = "False") -> bytes:
    text = f"{{'descr': {dtype}, 'fortran_order': {fortran}, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def hostile_array(raw: bytes, rng: np.random.Generator) -> bytes:
    """Return an npy file with another content, shape or type than the given one."""
    try:
        array = np.load(io.BytesIO(raw), allow_pickle=False)
    except Exception:  # an array damaged before
        return raw[: len(raw) // 2]
    body = raw[raw.index(b"\n") + 1 :]
    kind, shape = repr(array.dtype.str), str(array.shape)
    what = int(rng.integers(10))
    if what == 0:
        return _header(kind, str(rng.choice(_SHAPES))) + body
    if what == 1:
        return _header(repr(str(rng.choice(_DTYPES))), shape) + body
    if what == 2:
        return _header("'|O'", "(2,)") + pickle.dumps(["x", print])
    if what == 3:
        return _npy(np.resize(array, (*array.shape, 2)) if array.size else array)
    if what == 4:
        return _npy(array[..., :-1] if array.ndim and array.shape[-1] else array.reshape(1, -1))
    if what == 5:
        return _npy(np.zeros((0, *array.shape[1:]), array.dtype))
    if what == 6:
        return _npy(np.array(rng.choice(["x", "", "m" * 2000])))
    if array.dtype.kind not in "fiu" or not array.size:
        return _npy(np.zeros(array.shape))
    out = array.astype(float) if what < 9 else array.copy()
    bad = rng.choice([np.nan, np.inf, -1.0, 0.0, 1e308, 1e-320, 1e9])
    at = tuple(int(rng.integers(n)) for n in out.shape)
    if out.dtype.kind == "f":
        out[at if rng.random() < 0.5 else ...] = bad
    else:
        info = np.iinfo(out.dtype)
        out[at if rng.random() < 0.5 else ...] = rng.choice([info.max, info.min, 0, 9])
    return _npy(out)


@cache
def _bomb(gigabytes: int) -> tuple[bytes, int]:
    """Return a deflate stream of zeros, and its length unpacked."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = packer.compress(_header("'<f8'", f"({gigabytes << 27},)")) + packer.flush(
        zlib.Z_FULL_FLUSH
    )
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    return head + block * (gigabytes << 6) + packer.flush(), (gigabytes << 30) + 128


def members_of(raw: bytes) -> Members:
    """Return the files of an archive; none where it is damaged."""
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # an archive damaged before
        return {}


def packed(members: Members, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return an archive of files; the same for the same files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data, compress_type=method)
    return buffer.getvalue()


def _of_member(raw: bytes, rng: np.random.Generator, change: Callable[..., bytes]) -> bytes:
    members = members_of(raw)
    if not members:
        return raw[1:]
    name = list(members)[int(rng.integers(len(members)))]
    return packed({**members, name: change(members[name], rng)})


def arrays(raw: bytes, rng: np.random.Generator) -> bytes:
    """Replace an array of an npz file."""
    return _of_member(raw, rng, hostile_array)


def names(raw: bytes, rng: np.random.Generator) -> bytes:
    """Remove, rename or add a file of the archive, to a path outside of its folder, too."""
    members = members_of(raw)
    if not members:
        return raw[1:]
    name, other = (list(members)[int(rng.integers(len(members)))] for _ in range(2))
    data = members.pop(name)
    odd = ("", "x.npy", "../outside", "/tmp/outside", "a/../../outside", "m" * 300, "é.npy", "d/")
    what = int(rng.integers(4))
    if what == 0:
        return packed(members)
    if what == 1:
        return packed({str(rng.choice(odd)): data, **members})
    if what == 2:
        return packed({**members, name: members.get(other, b"")})
    return packed({**members, name: data, str(rng.choice(odd)): data})


def fields(raw: bytes, rng: np.random.Generator) -> bytes:
    """Change a field of the headers: method, encryption, version, checksum or lengths."""
    out = bytearray(raw)
    local, central = (
        [k for k in range(len(raw) - 46) if raw[k : k + 4] == sign]
        for sign in (b"PK\3\4", b"PK\1\2")
    )
    if not local or not central:
        return raw[1:]
    n = int(rng.integers(min(len(local), len(central))))
    width, at = [("H", 4), ("H", 6), ("H", 8), ("I", 14), ("I", 18), ("I", 22), ("H", 26)][
        int(rng.integers(7))
    ]
    most = 0xFFFF if width == "H" else 0xFFFFFFFF
    value = int(rng.choice([0, 1, 8, 9, 12, 14, 99, 0x20, 255, most, most >> 1]))
    where = int(rng.integers(3))
    if where != 1:
        struct.pack_into(f"<{width}", out, local[n] + at, value)
    if where != 0:
        struct.pack_into(f"<{width}", out, central[n] + at + 2, value)
    return bytes(out)


def bomb(raw: bytes, rng: np.random.Generator) -> bytes:
    """Add an array of three gigabytes, which takes a few megabytes in the file."""
    members = members_of(raw)
    if not members or rng.random() < 0.9:
        return fields(raw, rng)
    stream, size = _bomb(3)
    name = list(members)[int(rng.integers(len(members)))]
    out = bytearray(packed({n: data if n != name else b"" for n, data in members.items()}, 0))
    at = out.index(name.encode()) + len(name.encode())
    out[at:at] = stream
    local, central = at - len(name.encode()) - 30, out.index(b"PK\1\2", at + len(stream))
    while out[central + 46 : central + 46 + len(name.encode())] != name.encode():
        central = out.index(b"PK\1\2", central + 4)
    for place in (local + 8, central + 10):
        struct.pack_into("<H", out, place, 8)
    for place in (local + 18, central + 20):
        struct.pack_into("<II", out, place, len(stream), size)
    return _offsets_moved(bytes(out), local, len(stream))


def _offsets_moved(raw: bytes, since: int, by: int) -> bytes:
    """Move the places of files, and of their list, that lie behind what was inserted."""
    out, end = bytearray(raw), raw.rindex(b"PK\5\6")
    (start,) = struct.unpack_from("<I", out, end + 16)
    struct.pack_into("<I", out, end + 16, start + by)
    at = start + by
    while out[at : at + 4] == b"PK\1\2":
        (place,) = struct.unpack_from("<I", out, at + 42)
        if place > since:
            struct.pack_into("<I", out, at + 42, place + by)
        name, extra, comment = struct.unpack_from("<HHH", out, at + 28)
        at += 46 + name + extra + comment
    return bytes(out)


DAMAGES = (arrays, arrays, arrays, names, fields, bomb)
