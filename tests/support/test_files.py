"""Files are written whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from slipid.support.errors import DataError
from slipid.support.files import write_bytes


@pytest.mark.parametrize("path", [Path(""), Path("."), Path("/")])
def test_what_is_no_file_cannot_be_written(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match="cannot be written"):
        write_bytes(path, b"")
    assert list(tmp_path.iterdir()) == []
