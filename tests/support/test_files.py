"""Files are written whole or not at all, through links, and never in place of a device."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from slipid.support.errors import DataError
from slipid.support.files import target_of, writable, write_bytes, write_together
from tests.helpers.shared import invoke


@pytest.fixture
def small_disk(tmp_path):
    """A folder on a disk with room for 256 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", folder]
    if not (sys.platform == "linux" and os.geteuid() == 0 and shutil.which("mount")):
        pytest.skip("mounting a small disk needs Linux and root")
    if subprocess.run(words, capture_output=True).returncode:
        pytest.skip("this system does not allow mounts")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


@pytest.mark.parametrize("path", [Path(""), Path("."), Path("/"), Path("a\0b")])
def test_what_is_no_file_cannot_be_written(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match="cannot be written"):
        write_bytes(path, b"")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other devices")
def test_devices_and_pipes_stay_what_they_are(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("/dev/full")
    for path in ("/dev/null", "/dev/full", "/dev/stdout", "/proc/self/fd/1", "fifo", "link"):
        with pytest.raises(DataError, match=r"cannot be written \(a device or a pipe\)"):
            write_bytes(tmp_path / path, b"x")
    assert stat.S_ISFIFO((tmp_path / "fifo").stat().st_mode)
    assert stat.S_ISCHR(os.stat("/dev/full").st_mode)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["fifo", "link"]


def test_a_link_stays_and_its_file_is_replaced(tmp_path):
    (tmp_path / "real").mkdir()
    for name in ("there", "to come"):
        (tmp_path / name).symlink_to(tmp_path / "real" / name)
    (tmp_path / "real" / "there").write_bytes(b"old")
    for name in ("there", "to come"):
        write_bytes(tmp_path / name, b"new")
        assert (tmp_path / name).is_symlink()
        assert (tmp_path / "real" / name).read_bytes() == b"new"
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(DataError, match="loop: cannot be written"):
        write_bytes(tmp_path / "loop", b"")


def test_long_names_are_written_and_too_long_ones_are_a_short_sentence(tmp_path):
    write_bytes(tmp_path / ("n" * 255), b"x")
    write_bytes(tmp_path / ("Ω" * 127), b"x")
    with pytest.raises(DataError, match="File name too long") as error:
        write_bytes(Path("n" * 3000), b"")
    assert len(str(error.value)) < 500


def test_files_that_belong_together_stay_old_where_one_cannot_be_written(tmp_path):
    a, b, old = (tmp_path / name for name in ("a", "b", "old"))
    write_together({a: b"1", b: b"1", old: b"1"})
    (tmp_path / "c").mkdir()
    with pytest.raises(DataError, match="c: cannot be written"):
        write_together({a: b"2", b: b"2", tmp_path / "c": b"2"}, [old])
    assert [p.read_bytes() for p in (a, b, old)] == [b"1"] * 3
    write_together({a: b"2", b: b"2"}, [old, tmp_path / "absent"])
    assert [p.read_bytes() for p in (a, b)] == [b"2"] * 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b", "c"]


def test_a_link_through_which_a_file_is_written_is_not_deleted(tmp_path):
    target, link, folder = tmp_path / "target", tmp_path / "link", tmp_path / "folder"
    target.touch()
    link.symlink_to(target)
    folder.mkdir()
    with pytest.raises(DataError, match="folder: a folder; expected a file"):
        write_together({link: b"1"}, [target, folder])
    assert target.read_bytes() == b""
    write_together({link: b"1"}, [link])
    assert link.is_symlink()
    assert target.read_bytes() == b"1"


def test_a_full_disk_leaves_the_old_files(small_disk):
    a, b = small_disk / "a", small_disk / "b"
    write_together({a: b"old", b: b"old"})
    with pytest.raises(DataError, match=r"b: cannot be written \(No space left"):
        write_together({a: b"new", b: bytes(10**6)}, [a])
    assert [p.read_bytes() for p in (a, b)] == [b"old"] * 2
    assert sorted(p.name for p in small_disk.iterdir()) == ["a", "b"]


def test_a_folder_that_is_read_only_is_refused_before_the_work(small_disk):
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    with pytest.raises(DataError, match=r"cannot be written \(Read-only file system\)"):
        writable(small_disk)
    ended = invoke("check", "none.toml", "--data", ".", "--out", small_disk)
    assert ended.exit_code == 2


@pytest.mark.parametrize("name", ["*", "a?.json", "n" * 300, "", "a\nb", "/dev/full", "."])
def test_names_that_no_json_can_have_are_refused_before_the_work(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = invoke("check", "none.toml", "--data", ".", "--json", name)
    assert ended.exit_code == 2
    assert ended.stderr.startswith("--json ")
    assert len(ended.stderr) < 500
    assert ended.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_without_a_home_and_its_cache_commands_compute_and_draw_in_silence(tmp_path):
    code = (
        "import sys; from pathlib import Path\n"
        "from slipid.support.jax_setup import setup_jax; setup_jax(quiet=True)\n"
        "import jax; assert float(jax.jit(lambda x: x + 1)(1.0)) == 2.0\n"
        "def draw():\n"
        "    from slipid.plots import drawing\n"
        "    drawing.save(drawing.figure(2.0, 2.0, 'empty'), Path(sys.argv[1]))\n"
        "from slipid.cli import main; main.app = draw; main.main()\n"
    )
    gone = ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "JAX_COMPILATION_CACHE_DIR", "SLIPID_CACHE")
    kept = {k: v for k, v in os.environ.items() if k not in (*gone, "MPLCONFIGDIR")}
    nowhere = dict.fromkeys(("HOME", "TMPDIR"), "/dev/null/nowhere")
    words = [sys.executable, "-c", code, tmp_path / "empty.png"]
    for cache in ({}, {"JAX_COMPILATION_CACHE_DIR": "/dev/null/nowhere"}):
        done = subprocess.run(words, env=kept | nowhere | cache, check=True, capture_output=True)
        assert done.stderr == b""
    assert [p.name for p in tmp_path.iterdir()] == ["empty.png"]


def test_a_possible_name_is_its_own_target(tmp_path):
    assert target_of(tmp_path / "new" / "a.json") == (tmp_path / "new" / "a.json").resolve()
