"""Checkpoints load only complete parts of the same job, whatever happened to the files."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from slipid.support import checkpoint, files, parsing
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.errors import DataError
from slipid.support.files import read_arrays, write_arrays

ARRAYS = {"z": np.arange(3.0), "stage": "joint", "round": 4}
PLAIN = {"x": np.pi, "rows": [1.0 / 3.0, None, "a"]}


@pytest.fixture
def kept(tmp_path) -> Checkpoint:
    kept = Checkpoint(tmp_path / "folder", "mine")
    kept.save("part", ARRAYS)
    kept.save_json("part", PLAIN)
    return kept


def test_what_is_kept_comes_back(kept):
    back = kept.load("part")
    assert set(back) == set(ARRAYS)
    np.testing.assert_array_equal(back["z"], ARRAYS["z"])
    assert (str(back["stage"]), int(back["round"])) == ("joint", 4)
    assert kept.load_json("part") == PLAIN


@pytest.mark.parametrize("time_s", [0.0, 4e9])
def test_times_of_files_mean_nothing(kept, time_s):
    """The clock may have been set back, or forward."""
    for suffix in ("npz", "json"):
        os.utime(kept.folder / f"part.{suffix}", (time_s, time_s))
    assert kept.load("part") is not None
    assert kept.load_json("part") == PLAIN


def test_parts_of_other_work_are_absent(kept):
    other = Checkpoint(kept.folder, "other")
    assert other.load("part") is None
    assert other.load_json("part") is None
    other.save("part", {"z": np.zeros(1)})
    assert kept.load("part") is None


def test_parts_that_were_never_kept_are_absent(kept, tmp_path):
    for one in (kept, Checkpoint(tmp_path / "nowhere", "mine")):
        assert one.load("none") is None
        assert one.load_json("none") is None


@pytest.mark.parametrize("length", [0, 1, 50, 100, -9])
def test_damaged_files_are_absent_and_that_is_logged(kept, length, caplog):
    for suffix in ("npz", "json"):
        path = kept.folder / f"part.{suffix}"
        path.write_bytes(path.read_bytes()[:length])
    assert kept.load("part") is None
    assert kept.load_json("part") is None
    assert len(caplog.messages) == 2
    assert all("it is computed again" in message for message in caplog.messages)


def test_an_edited_number_is_noticed(kept, caplog):
    path = kept.folder / "part.json"
    path.write_text(path.read_text().replace("3.14", "3.24"))
    assert kept.load_json("part") is None
    assert "does not match its checksum" in caplog.text


@pytest.mark.parametrize(
    "other", [{"z": np.arange(4.0)}, {"z": np.arange(3)}, {"y": np.arange(3.0)}]
)
def test_arrays_that_were_exchanged_are_noticed(kept, other, caplog):
    arrays = read_arrays(kept.folder / "part.npz", "a checkpoint")
    rest = {name: array for name, array in arrays.items() if name != "z"}
    write_arrays(kept.folder / "part.npz", rest | other)
    assert kept.load("part") is None
    assert "does not match its checksum; it is computed again" in caplog.text


def test_absent_and_other_parts_are_not_logged(kept, caplog):
    assert Checkpoint(kept.folder, "other").load_json("part") is None
    assert kept.load("none") is None
    assert not caplog.messages


@pytest.mark.parametrize("text", ["[]", "null", '{"key": "mine"}', '{"content": 1}'])
def test_other_json_is_absent(kept, text):
    (kept.folder / "part.json").write_text(text)
    assert kept.load_json("part") is None


def test_only_what_matches_is_removed_and_an_empty_folder_goes_too(kept):
    kept.remove("*.npz")
    assert kept.load("part") is None
    assert kept.load_json("part") == PLAIN
    kept.remove()
    assert not kept.folder.exists()
    kept.remove()


@pytest.mark.parametrize(
    "other",
    [
        ("a", 1, np.arange(4.0)),
        ("a", 2, np.arange(3.0)),
        ("b", 1, np.arange(3.0)),
        ("a", 1, np.arange(3)),
        ("a", 1, np.arange(3.0)[None]),
        ("a", 1),
        ("a1", np.arange(3.0)),
        (1, "a", np.arange(3.0)),
    ],
    ids=str,
)
def test_a_key_tells_any_part_apart(other):
    mine = ("a", 1, np.arange(3.0))
    assert key_of(*mine) == key_of(*mine)
    assert key_of(*mine) != key_of(*other)


def test_a_key_knows_the_versions(monkeypatch):
    before = key_of("a")
    monkeypatch.setattr("slipid.support.checkpoint.versions", lambda: {"jax": "0.0"})
    assert key_of("a") != before


WRITER = """
import numpy as np
from pathlib import Path
from slipid.support import checkpoint, files, parsing
from slipid.support.checkpoint import Checkpoint
kept = Checkpoint(Path({folder!r}), "mine")
for k in range(100_000):
    kept.save("part", {{"value": np.full(20_000, float(k))}})
    kept.save_json("part", [k] * 2000)
"""


@pytest.mark.slow
def test_a_kill_leaves_every_part_whole(tmp_path):
    rng = np.random.default_rng(0)
    kept, path = Checkpoint(tmp_path, "mine"), tmp_path / "part.json"
    for _ in range(5):
        kept.remove()
        tmp_path.mkdir(exist_ok=True)
        run = subprocess.Popen([sys.executable, "-c", WRITER.format(folder=str(tmp_path))])
        deadline = time.monotonic() + 60
        while not path.exists():
            assert run.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.005)
        time.sleep(rng.uniform(0.0, 0.05))
        os.kill(run.pid, signal.SIGKILL)
        run.wait()
        arrays, plain = kept.load("part"), kept.load_json("part")
        assert arrays is not None
        assert plain is not None
        assert len(set(arrays["value"].tolist())) == len(set(plain)) == 1


def test_sources_are_of_packages_and_of_single_modules():
    one, other, both = (
        source_hash(*rooms)
        for rooms in (("parameter",), ("lab/trial",), ("parameter", "lab/trial"))
    )
    assert len({one, other, both, source_hash("lab")}) == 4
    with pytest.raises(FileNotFoundError):
        source_hash("no_such_package")


def test_parts_that_cannot_be_loaded_are_logged_when_they_are_saved(kept, monkeypatch, caplog):
    monkeypatch.setattr(checkpoint, "MOST_PART_BYTES", 99)
    kept.save("large", {"z": np.zeros(13)})
    assert "104 bytes, too much for a checkpoint (at most 99)" in caplog.text
    assert not (kept.folder / "large.npz").exists()


def test_the_largest_file_of_arrays_has_the_largest_arrays(kept, monkeypatch):
    assert checkpoint.MOST_PART_BYTES < parsing.MOST_ARRAY_BYTES
    monkeypatch.setattr(files, "MOST_ARRAY_BYTES", 100 - 2**20)
    with pytest.raises(DataError, match="at most 100 bytes"):
        read_arrays(kept.folder / "part.npz", "a part")
