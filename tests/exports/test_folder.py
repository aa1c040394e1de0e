"""A folder for a robot tells a changed byte, and is never written over other people's files."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from slipid.exports.folder import SUMS, check_folder, write_folder
from slipid.support.errors import DataError
from slipid.support.files import write_bytes

CONTENT = {"README.md": b"# one\n", "c/src/slipid.c": b"int x;\n", "robot.json": b"{}\n"}


@pytest.fixture
def folder(tmp_path):
    write_folder(tmp_path / "robot", CONTENT)
    return tmp_path / "robot"


def test_what_was_written_is_whole(folder):
    assert sorted(check_folder(folder)) == sorted(CONTENT)
    assert (folder / "c/src/slipid.c").read_bytes() == CONTENT["c/src/slipid.c"]


@pytest.mark.parametrize("name", CONTENT)
def test_a_changed_byte_is_reported_with_its_file(folder, name):
    data = bytearray((folder / name).read_bytes())
    data[0] ^= 1
    (folder / name).write_bytes(bytes(data))
    with pytest.raises(DataError, match=rf"{name}: changed or damaged"):
        check_folder(folder)


def test_added_and_lost_files_are_reported(folder):
    (folder / "c/src/more.c").write_text("int y;\n")
    with pytest.raises(DataError, match=r"more\.c: added after the export"):
        check_folder(folder)
    (folder / "c/src/slipid.c").unlink()
    with pytest.raises(DataError, match=r"slipid\.c: No such file"):
        check_folder(folder)


@pytest.mark.parametrize("sums", [b"", b"no digest here\n", b"\xff\xfe"])
def test_a_folder_without_its_checksums_is_none(folder, sums):
    (folder / SUMS).write_bytes(sums)
    with pytest.raises(DataError, match="expected a folder that `slipid export` wrote"):
        check_folder(folder)
    (folder / SUMS).unlink()
    with pytest.raises(DataError, match="expected a folder that `slipid export` wrote"):
        check_folder(folder)


def test_a_name_that_leads_out_of_the_folder_is_refused(folder):
    outside = folder.parent / "other"
    outside.write_bytes(b"")
    digest = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    (folder / SUMS).write_text(f"{digest}  ../other\n")
    with pytest.raises(DataError, match="expected a folder that `slipid export` wrote"):
        check_folder(folder)
    with pytest.raises(DataError):
        write_folder(folder, CONTENT)
    assert outside.exists()


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="needs sha256sum")
def test_it_is_checked_where_there_is_no_slipid(folder):
    command = ["sha256sum", "--quiet", "--strict", "-c", SUMS]
    assert subprocess.run(command, cwd=folder).returncode == 0
    (folder / "README.md").write_bytes(b"# two\n")
    assert subprocess.run(command, cwd=folder, capture_output=True).returncode == 1


def test_an_older_export_leaves_nothing_behind(folder):
    write_folder(folder, {"README.md": b"# two\n"})
    assert check_folder(folder) == ("README.md",)
    assert not (folder / "c").exists()


def test_what_is_built_of_it_is_no_part_of_it(folder):
    (folder / "c/build").mkdir()
    (folder / "c/build/check").write_text("a program")
    assert sorted(check_folder(folder)) == sorted(CONTENT)
    write_folder(folder, {"README.md": b"# two\n"})
    assert check_folder(folder) == ("README.md",)
    assert (folder / "c/build/check").read_text() == "a program"


def test_a_file_that_was_changed_by_hand_is_never_lost(folder):
    (folder / "c/src/slipid.c").write_text("int own;\n")
    with pytest.raises(DataError, match=r"slipid\.c: changed since it was exported"):
        write_folder(folder, CONTENT)
    assert (folder / "c/src/slipid.c").read_text() == "int own;\n"
    assert (folder / "README.md").exists()


def test_a_folder_that_was_cut_short_can_be_written_again(folder, monkeypatch):
    """However many files were written before."""

    def full(path, data):
        if path.name == "slipid.c":
            raise OSError("no space left")
        write_bytes(path, data)

    new = {**CONTENT, "c/src/more.c": b"int z;\n", "README.md": b"# two\n"}
    with monkeypatch.context() as m:
        m.setattr("slipid.exports.folder.write_bytes", full)
        with pytest.raises(OSError, match="no space"):
            write_folder(folder, new)
    with pytest.raises(DataError, match="No such file"):
        check_folder(folder)
    write_folder(folder, new)
    assert sorted(check_folder(folder)) == sorted(new)


def test_what_a_killed_process_left_is_cleared(folder):
    for name in ("c/src/.slipid.c.slipid-0123abcd", f".{SUMS}.slipid-89abcdef"):
        (folder / name).write_text("a par")
    with pytest.raises(DataError, match="added after the export"):
        check_folder(folder)
    write_folder(folder, CONTENT)
    assert sorted(check_folder(folder)) == sorted(CONTENT)
    (folder / ".mine.0123abcd").write_text("kept")
    with pytest.raises(DataError, match="files that an export did not write"):
        write_folder(folder, CONTENT)
    assert (folder / ".mine.0123abcd").read_text() == "kept"


def test_other_files_are_never_touched(folder):
    (folder / "mine.txt").write_text("kept")
    with pytest.raises(DataError, match=r"files that an export did not write \(mine.txt\)"):
        write_folder(folder, CONTENT)
    assert (folder / "mine.txt").read_text() == "kept"
    assert (folder / "README.md").read_bytes() == CONTENT["README.md"]
    (folder.parent / "file").write_text("")
    with pytest.raises(DataError, match="not a folder"):
        write_folder(folder.parent / "file", CONTENT)
