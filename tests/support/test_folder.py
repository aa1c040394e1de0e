"""One command at a time writes to a folder, and what a killed one left there is deleted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slipid.cli import design, motor
from slipid.infer.design.proposal import COLUMNS
from slipid.support.errors import DataError
from slipid.support.files import write_bytes
from slipid.support.folder import (
    LOCK,
    MARKED,
    MARKS,
    locked,
    name_of_temporary,
    refuse_foreign,
    temporary_of,
)

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")


def holder(folder: Path) -> subprocess.Popen:
    """A process that has the lock of a folder until it is ended."""
    code = (
        "import signal, sys, time; from pathlib import Path\n"
        "from slipid.support.folder import locked\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background\n"
        "with locked(Path(sys.argv[1]), 'sample'):\n"
        "    print('locked', flush=True)\n"
        "    time.sleep(600)\n"
    )
    run = subprocess.Popen([sys.executable, "-c", code, folder], stdout=subprocess.PIPE, text=True)
    assert run.stdout.readline() == "locked\n"
    return run


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_lock_names_its_owner_and_ends_with_it(tmp_path, how):
    out = tmp_path / "out"
    out.mkdir()
    run = holder(out)
    with (
        pytest.raises(DataError, match=rf"out: `slipid sample` \(process {run.pid}\) is writing"),
        locked(out, "identify"),
    ):
        pass
    run.send_signal(how)
    run.communicate(timeout=60)
    with locked(out, "identify"):
        assert (out / LOCK).read_text() == f"`slipid identify` (process {os.getpid()})"
    assert not list(out.iterdir())


def test_a_folder_that_was_made_for_nothing_is_removed_with_those_above(tmp_path):
    with pytest.raises(DataError, match="bad logs"), locked(tmp_path / "a" / "b", "identify"):
        raise DataError("bad logs")
    assert not list(tmp_path.iterdir())
    with locked(tmp_path / "a" / "b", "identify"):
        (tmp_path / "a" / "b" / "result").touch()
    assert [p.name for p in (tmp_path / "a" / "b").iterdir()] == ["result"]


def test_leftovers_of_killed_commands_are_deleted_and_nothing_else(tmp_path):
    kept = [".hidden", "a.json", ".bashrc.20240131", ".a.slipid-0123456", "a.slipid-01234567"]
    kept += [".git/.x.json.slipid-01234567", "used/.x.json.slipid-01234567", f"used/{LOCK}"]
    left = [temporary_of(tmp_path / name) for name in ("a.json", "sub/b.npz", "n" * 255)]
    for path in (*left, *(tmp_path / name for name in kept)):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    assert name_of_temporary(f"sub/{left[1].name}") == "sub/b.npz"
    with locked(tmp_path, "identify"):
        pass
    assert not any(path.exists() for path in left)
    assert all((tmp_path / name).exists() for name in kept)


def test_a_lock_that_cannot_be_written_can_be_taken(tmp_path, monkeypatch):
    opened = os.open

    def not_mine(path, flags, *mode):
        if flags & os.O_RDWR:
            raise PermissionError(13, "Permission denied")
        return opened(path, flags, *mode)

    (tmp_path / LOCK).write_text("somebody else, long ago")
    monkeypatch.setattr(os, "open", not_mine)
    with (
        locked(tmp_path, "identify"),
        pytest.raises(DataError, match="long ago is writing"),
        locked(tmp_path, "sample"),
    ):
        pass


def test_a_folder_without_permission_and_links_that_lead_nowhere_say_so(tmp_path, monkeypatch):
    (tmp_path / "dangling").symlink_to("nowhere")
    (tmp_path / "loop").symlink_to("loop")
    for name in ("dangling", "loop", "dangling/a", "loop/a"):
        found = rf"cannot be written \('.*{name.partition('/')[0]}' is a link that leads nowhere\)"
        with pytest.raises(DataError, match=found), locked(tmp_path / name, "design"):
            pass
    opened = os.open

    def refused(path, flags, *mode):
        if flags & os.O_CREAT:
            raise PermissionError(13, "Permission denied")
        return opened(path, flags, *mode)

    monkeypatch.setattr(os, "open", refused)
    with pytest.raises(DataError, match="Permission denied"), locked(tmp_path, "design"):
        pass


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "a.csv").touch()
    with (
        pytest.raises(DataError, match=r"a\.csv: a file; expected a writable folder"),
        locked(tmp_path / "a.csv", "design"),
    ):
        pass


def test_where_locks_are_not_supported_work_goes_on(tmp_path, monkeypatch):
    import fcntl

    def unsupported(*_: object) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    with locked(tmp_path, "identify"), locked(tmp_path, "sample"):
        (tmp_path / "result").touch()
    assert [p.name for p in tmp_path.iterdir()] == ["result"]


@pytest.mark.parametrize("suffix", MARKS)
def test_a_file_that_slipid_did_not_write_is_kept(tmp_path, suffix):
    path = tmp_path / f"mine{suffix}"
    new = b"{" + MARKS[suffix] + b"new"
    zeros = bytes(2 * MARKED)  # as after a power cut
    for content in (b"", zeros, new, MARKS[suffix] + b"damaged"):  # may be replaced
        path.write_bytes(content)
        write_bytes(path, new)
        assert path.read_bytes() == new
    path.write_bytes(b"photo")
    with pytest.raises(DataError, match=r"mine.*: exists and was not written by slipid"):
        write_bytes(path, new)
    with (
        pytest.raises(DataError, match=r"mine.*: exists and was not written by slipid"),
        locked(tmp_path, "check", path.name),
    ):
        pass
    assert path.read_bytes() == b"photo"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_all_files_of_a_command_are_checked_before_the_work(tmp_path):
    for name in ("bench_a.png", "motor_feedforward.yaml", "motor_feedforward.h"):
        (tmp_path / name).write_bytes(b"mine")
        with pytest.raises(DataError, match=name), locked(tmp_path, "motor", *motor.NAMES):
            pass
        (tmp_path / name).unlink()
    for name in ("bench_a.json", "design_commands.csv"):  # not of this command
        (tmp_path / name).write_bytes(b"mine")
    with locked(tmp_path, "motor", *motor.NAMES):
        pass
    with pytest.raises(DataError, match="design_commands"), locked(tmp_path, "d", *design.NAMES):
        pass
    (tmp_path / "design_commands.csv").write_text(COLUMNS)
    with locked(tmp_path, "design", *design.NAMES):
        pass


def test_json_with_sorted_keys_is_still_that_of_slipid(tmp_path):
    (tmp_path / "fit.json").write_text(
        json.dumps({"a": "x" * MARKED, "schema": "slipid.fit/9", "z": "x" * MARKED})
    )
    refuse_foreign(tmp_path / "fit.json")
    (tmp_path / "fit.json").write_text(json.dumps({"a": "x" * 2 * MARKED}))
    with pytest.raises(DataError, match="not written by slipid"):
        refuse_foreign(tmp_path / "fit.json")


def test_pictures_of_earlier_versions_are_replaced_beside_a_result(tmp_path):
    old, new = b"Software\0Matplotlib version3.10", b"Software\0slipid"
    picture = tmp_path / "paths.png"
    picture.write_bytes(old)
    with pytest.raises(DataError, match=r"paths\.png: exists and was not written by slipid"):
        write_bytes(picture, new)
    (tmp_path / "run.json").write_text('{"schema": "slipid.run/1"}')
    write_bytes(picture, new)
    assert picture.read_bytes() == new
