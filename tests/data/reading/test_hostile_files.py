"""Damaged and hostile logs that only libraries read are refused in one sentence, within limits."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml

from slipid.app import logs
from slipid.data.reading import table
from slipid.data.reading.bag import unpacking
from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.data.reading.end_poses import read_end_poses
from slipid.data.reading.table import parquet_names, parquet_numbers
from slipid.support.errors import DataError, refused_as
from tests.helpers.made_bags import in_order, joint_states
from tests.helpers.made_ulogs import write_ulog
from tests.helpers.one_bag import ANGLE, RESOLUTION, TIME, bag, runs_of

LAYOUT = declared_bag_layout(
    {"joints": ["left", "right"], "topics": {"wheel_angle": {"topic": "/joint_states"}}}, "layout"
)


def wheels():
    return in_order(joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE))


def refused(path: Path, read, expected: str) -> None:
    with pytest.raises(DataError, match=expected) as caught:
        read()
    assert str(path) in str(caught.value)
    assert "; expected " in str(caught.value)


# Parquet


DAMAGED_PARQUET = {
    "thrift": lambda raw: raw[: -8 - int.from_bytes(raw[-8:-4], "little")] + b"\x1f" + raw[-50:],
    "names": lambda raw: raw.replace(b"column", b"col\xd6mn"),
    "page": lambda raw: raw[:4] + bytes(40) + raw[44:],
    "cut": lambda raw: raw[:-20],
    "other": lambda raw: b"PAR1" * 20,
}


@pytest.mark.parametrize("name", DAMAGED_PARQUET)
def test_errors_of_pyarrow_become_sentences(name, tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="Parquet files need the extra parquet")
    from pyarrow import parquet

    path = tmp_path / "a.parquet"
    columns = pyarrow.table({"column": np.arange(30.0), "other": np.arange(30)})
    parquet.write_table(columns, path, store_schema=False)
    whole = path.read_bytes()
    assert parquet_numbers(path, whole, ("column", "other"))[0].shape == (30, 2)
    damaged = DAMAGED_PARQUET[name](whole)
    refused(
        path,
        lambda: parquet_numbers(path, damaged, ("column", "other")),
        r"a.parquet: cannot be read \(",
    )


def test_a_parquet_file_of_too_many_cells_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    pyarrow = pytest.importorskip("pyarrow", reason="Parquet files need the extra parquet")
    from pyarrow import parquet

    path = tmp_path / "a.parquet"
    columns = {name: np.arange(30) for name in ("z", "x.y", "t", "x")}
    parquet.write_table(pyarrow.table(columns | {"s": [{"a": 1, "b": 2}] * 30}), path)
    raw = path.read_bytes()
    monkeypatch.setattr(table, "MOST_CELLS", 60)
    values, texts = parquet_numbers(path, raw, ("t", "z"))
    assert values.shape == (30, 2)
    assert not texts
    assert parquet_names(path, raw) == ["z", "x.y", "t", "x", "s"]
    monkeypatch.setattr(table, "MOST_CELLS", 59)
    monkeypatch.setattr(parquet.ParquetFile, "read", lambda self, **_: pytest.fail("decoded"))
    for names in (("t", "z"), ("s",)):
        refused(path, lambda names=names: parquet_numbers(path, raw, names), "60 cells")


# bags


def with_metadata(change):
    """The change of the content of metadata.yaml by a function of its table and first topic."""

    def changed_text(text: str) -> str:
        content = yaml.safe_load(text)
        about = content["rosbag2_bagfile_information"]
        change(about, about["topics_with_message_count"][0])
        return yaml.safe_dump(content)

    return changed_text


HOSTILE_METADATA = {
    "name": with_metadata(lambda about, topic: topic["topic_metadata"].update(name={})),
    "no name": with_metadata(lambda about, topic: topic["topic_metadata"].update(name=None)),
    "type": with_metadata(lambda about, topic: topic["topic_metadata"].update(type=1.5)),
    "count": with_metadata(lambda about, topic: topic.update(message_count=None)),
    "list": with_metadata(lambda about, topic: about.update(topics_with_message_count=3)),
    "references": lambda text: (
        "a0: &a0 [x]\n"
        + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 40))
        + text.replace("storage_identifier: sqlite3", "storage_identifier: *a39")
    ),
    "depth": lambda text: text + "x: " + "[" * 2000,
    "no text": lambda text: "\0",
}


@pytest.mark.parametrize("name", HOSTILE_METADATA)
def test_metadata_of_any_types_is_refused(name, tmp_path):
    path = bag(tmp_path, "sqlite3", wheels())
    file = path / "metadata.yaml"
    file.write_text(HOSTILE_METADATA[name](file.read_text()))
    refused(
        path,
        lambda: runs_of(path, LAYOUT),
        "the bag is damaged .* run: ros2 bag reindex|\\.recover",
    )


def test_metadata_of_files_that_are_no_list_does_no_harm(tmp_path):
    path = bag(tmp_path, "mcap", wheels())
    file = path / "metadata.yaml"
    file.write_text(with_metadata(lambda about, _: about.update(files="x"))(file.read_text()))
    (run,) = runs_of(path, LAYOUT)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)


@pytest.mark.parametrize(
    ("storage", "compression"),
    [
        *(("rosbag1", "LZ4"), ("rosbag1", "BZ2"), ("sqlite3", "FILE"), ("sqlite3", "MESSAGE")),
        *(("mcap", "FILE"), ("mcap", "MESSAGE"), ("mcap", "STORAGE")),
    ],
)
def test_compressed_bags_are_read_within_a_limit(storage, compression, tmp_path, monkeypatch):
    path = bag(tmp_path, storage, wheels(), compression=compression)
    (run,) = runs_of(path, LAYOUT)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE, atol=RESOLUTION)
    monkeypatch.setattr(unpacking, "MOST_BYTES", 50)
    monkeypatch.setattr(unpacking, "MOST_TIMES", 0)
    refused(path, lambda: runs_of(path, LAYOUT), "over 50 bytes")


# ULog

ULOG = declared_bag_layout(
    {"topics": {"wheel_angle": {"topic": "wheels", "field": "angle", "unit": "rad"}}}, "layout"
)
HOSTILE_ULOGS = {
    "a format in itself": {"wheels": "uint64_t timestamp;float[2] angle;wheels more;"},
    "large formats": {
        "wheels": "uint64_t timestamp;float[2] angle;a[9999] more;",
        "a": "b[9999] b;",
        "b": "double[9999] c;",
    },
}


@pytest.mark.parametrize("name", HOSTILE_ULOGS)
def test_formats_of_impossible_size_are_refused(name, tmp_path, capsys):
    path = write_ulog(tmp_path / "a.ulg", HOSTILE_ULOGS[name], [("wheels", 1, bytes(16))])
    refused(path, lambda: runs_of(path, ULOG), "messages '.*' of over 65536 bytes")
    assert capsys.readouterr().out == ""


def test_a_log_in_which_pyulog_goes_back_for_ever_is_refused(tmp_path, capsys):
    # an unknown record that claims to be longer than the file
    head = b"ULog\x01\x12\x35\x01" + bytes(8)
    path = tmp_path / "a.ulg"
    path.write_bytes(head + b"\xff\xffz" * 30000)
    refused(path, lambda: runs_of(path, ULOG), "the bag is damaged")
    assert capsys.readouterr().out == ""


# tables, and the logs that ship with slipid


@pytest.mark.parametrize(
    "raw", [b"run,x_m\n" + b"m" * 200_000 + b",1\n", b"run,x_m\n\0,1\n", b"\xff\xfea"]
)
def test_tables_that_the_csv_module_refuses(raw, tmp_path):
    path = tmp_path / "ends.csv"
    path.write_bytes(raw)
    refused(path, lambda: read_end_poses(path), "ends.csv")


@pytest.mark.parametrize("name", ["../outside", "/outside", "a/../../outside"])
def test_an_archive_of_logs_writes_nothing_outside_of_its_folder(name, tmp_path, monkeypatch):
    path = tmp_path / "recorded.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("first.csv", "t\n")
        archive.writestr(name, "t\n")
    monkeypatch.setattr(logs, "RECORDED", path)
    refused(path, lambda: logs.unpack(tmp_path / "new"), "recorded.zip: the path .*outside'")
    assert [p.name for p in tmp_path.iterdir()] == ["recorded.zip"]


@pytest.mark.parametrize("damage", [lambda raw: raw[:200], lambda raw: b"PK" * 90, None])
def test_a_damaged_archive_of_logs_is_refused(damage, tmp_path, monkeypatch):
    path = tmp_path / "recorded.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("first.csv", "t\n" * 200)
    if damage is None:
        monkeypatch.setattr(logs, "MOST_RECORDED", 399)
    else:
        path.write_bytes(damage(path.read_bytes()))
    monkeypatch.setattr(logs, "RECORDED", path)
    refused(path, lambda: logs.unpack(tmp_path / "new"), "recorded.zip: (cannot|400 bytes)")


def test_errors_of_libraries_name_the_file():
    for error, shown in ((ValueError(" bad\n  line "), "bad line"), (MemoryError(), "MemoryError")):
        match = rf"^a.x: cannot be read \({shown}\); expected a thing$"
        with pytest.raises(DataError, match=match), refused_as("a.x", "a thing"):
            raise error
    with pytest.raises(DataError, match=r"^mine$"), refused_as("a.x", "a thing"):
        raise DataError("mine")
