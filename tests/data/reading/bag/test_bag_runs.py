"""Several runs in one bag: by a topic, by pauses, by a table."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.support.errors import DataError
from tests.helpers.made_bags import STORAGES, SUFFIX, Message, in_order, joint_states, write_bag
from tests.helpers.one_bag import runs_of

START = 1.7e9
TIME = START + np.arange(0.0, 30.0, 0.02)
# moves in 2..7, 12..17 and 22..27 s, with an encoder that flickers all the time
PHASE = np.clip((TIME - START - 2) % 10, 0, 5) + 5 * ((TIME - START - 2) // 10)
FLICKER = 1e-3 * (np.arange(len(TIME)) % 2)
ANGLE = np.column_stack([PHASE + FLICKER, -2 * PHASE])


def runs(tmp_path, rule, *messages, storage="mcap", topics=None, **given):
    topics = topics or {"wheel_angle": {"topic": "/joint_states"}}
    wheels = joint_states("/joint_states", TIME, ["l", "r"], position=ANGLE, velocity=speed())
    path = write_bag(tmp_path / f"bag{SUFFIX[storage]}", storage, in_order(wheels, *messages))
    table = {"joints": ["l", "r"], "topics": topics, "runs": rule, **given}
    return runs_of(path, declared_bag_layout(table, "layout"))


def speed():
    return np.gradient(ANGLE - FLICKER[:, None], TIME, axis=0)


def spans(found, name="wheel_angle"):
    return [
        (one.identity.name, *(round(float(t), 2) for t in one.signals[name].time[[0, -1]] - START))
        for one in found
    ]


def markers(name, values):
    return [Message("/run", f"std_msgs/msg/{name}", {"data": v}, START + t) for t, v in values]


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bool_marks_begin_and_end(tmp_path, storage):
    messages = markers(
        "Bool", [(1, True), (3, True), (8, False), (9, False), (11, True), (18, False)]
    )
    found = runs(tmp_path, {"topic": "/run"}, messages, storage=storage)
    assert spans(found) == [("#01", 1.0, 7.98), ("#02", 11.0, 17.98)]


def test_a_value_lasts_until_it_changes(tmp_path):
    messages = markers("Int32", [(0.5, 1), (1, 1), (10, 2), (20, 0), (21, 3)])
    found = runs(tmp_path, {"topic": "/run"}, messages)
    assert spans(found) == [("#01", 0.5, 9.98), ("#02", 10.0, 19.98), ("#03", 21.0, 29.98)]


def test_a_counter_from_zero(tmp_path):
    messages = markers("Int32", [(1, 0), (10, 1)])
    found = runs(tmp_path, {"topic": "/run", "between": []}, messages)
    assert spans(found) == [("#01", 1.0, 9.98), ("#02", 10.0, 29.98)]


def test_a_text_may_name_the_floor(tmp_path):
    messages = markers("String", [(1, "gray"), (8, ""), (11, "green"), (18, "stop")])
    rule = {"topic": "/run", "surface": "data", "between": ["", "stop"]}
    found = runs(tmp_path, rule, messages)
    assert spans(found) == [("#01", 1.0, 7.98), ("#02", 11.0, 17.98)]
    assert [(one.identity.surface, one.identity.load) for one in found] == [
        ("gray", "as_built"),
        ("green", "as_built"),
    ]


def test_fields_of_a_marker_name_floor_and_load(tmp_path):
    text = {"my_msgs/msg/Run": "std_msgs/Header header\nuint8 trial\nstring floor\nstring load\n"}
    messages = [
        Message(
            "/run",
            "my_msgs/msg/Run",
            {"header": {"stamp": START + t}, "trial": n, "floor": floor, "load": "moved"},
            START + t + 0.4,
        )
        for t, n, floor in ((1, 1, "gray"), (10, 2, "gray"), (20, 2, "green"))
    ]
    wheels = joint_states("/joint_states", TIME, ["l", "r"], position=ANGLE)
    path = write_bag(tmp_path / "bag", "mcap", in_order(wheels, messages), definitions=text)
    rule = {"topic": "/run", "field": "trial", "surface": "floor", "load": "load"}
    table = {"joints": ["l", "r"], "topics": {"wheel_angle": {"topic": "/joint_states"}}}
    found = runs_of(path, declared_bag_layout({**table, "runs": rule}, "layout"))
    assert spans(found) == [("#01", 1.0, 9.98), ("#02", 10.0, 19.98), ("#03", 20.0, 29.98)]
    assert [(one.identity.surface, one.identity.load) for one in found] == [
        ("gray", "moved"),
        ("gray", "moved"),
        ("green", "moved"),
    ]


@pytest.mark.parametrize("name", ["wheel_angle", "motor_speed"])
def test_pauses_part_runs(tmp_path, name):
    given = {"gear_ratio": 4.0} if name == "motor_speed" else {}
    topics = {name: {"topic": "/joint_states"}}
    found = runs(tmp_path, {"pause_s": 2.0}, topics=topics, **given)
    assert [one.identity.name for one in found] == ["#01", "#02", "#03"]
    for k, (_, first, last) in enumerate(spans(found, name)):
        assert first == pytest.approx(10 * k + 1, abs=0.05)
        assert last == pytest.approx(10 * k + 8, abs=0.05)


def test_a_longer_pause_parts_nothing(tmp_path):
    found = runs(tmp_path, {"pause_s": 6.0})
    assert [one.identity.name for one in found] == [""]


def test_a_table_tells_runs_floors_and_loads(tmp_path):
    (tmp_path / "runs.csv").write_text(
        "start,end,surface,load,name,bag\n1,8,gray,,first,\n11,18,green,moved,,bag\n20,25,,,,other\n"
    )
    found = runs(tmp_path, {"table": "runs.csv", "from_start": True})
    assert spans(found) == [("#first", 1.0, 7.98), ("#02", 11.0, 17.98)]
    assert [(one.identity.surface, one.identity.load) for one in found] == [
        ("gray", "as_built"),
        ("green", "moved"),
    ]


def test_a_table_of_stamps(tmp_path):
    (tmp_path / "runs.csv").write_text(f"start,end\n{START + 1},{START + 8}\n1,2\n")
    found = runs(tmp_path, {"table": "runs.csv"})
    assert spans(found) == [("", 1.0, 7.98)]
    assert "1 runs without samples" in found[0].notes[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("begin,end\n1,2\n", ("row 2: start: missing", "begin: no such key", "start, end")),
        ("start,ends\n1,2\n", ("ends: no such key, did you mean end",)),
        ("start,surface\n1,2\n", ("row 2: end: missing",)),
        ("start,end\n1,2\n5,soon\n", ("row 3: end: 'soon'", "a valid number")),
        ("start,end\n2,1\n", ("row 2: a run from 2 to 1 s", "start before end")),
        ("start,end\n1,2\n", ("no run of table", "1700000000.000", "from_start = true")),
        (None, ("runs.csv: No such file", "CSV table of runs")),
    ],
)
def test_wrong_tables(tmp_path, text, words):
    if text is not None:
        (tmp_path / "runs.csv").write_text(text)
    with pytest.raises(DataError) as caught:
        runs(tmp_path, {"table": "runs.csv"})
    assert all(word in str(caught.value) for word in words), caught.value


@pytest.mark.parametrize(
    ("rule", "messages", "words"),
    [
        ({"topic": "/ran"}, [(1, True)], ("no topic '/ran'", "did you mean /run")),
        ({"topic": "/run", "field": "on"}, [(1, True)], ("no field 'on'", "one of data")),
        ({"topic": "/run"}, [(1, False)], ("no run in topic '/run'", "between runs")),
        ({"topic": "/run"}, [(99, True)], ("no sample in the runs", "from 1700000000.000")),
        ({"pause_s": 1.0}, [(1, True)], ("no wheel moves", "0.02 rad")),
    ],
)
def test_no_runs(tmp_path, rule, messages, words, monkeypatch):
    if "pause_s" in rule:
        monkeypatch.setattr(f"{__name__}.ANGLE", np.zeros((len(TIME), 2)))
    with pytest.raises(DataError) as caught:
        runs(tmp_path, rule, markers("Bool", messages))
    assert all(word in str(caught.value) for word in words), caught.value
