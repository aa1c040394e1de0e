"""Damaged files at every door of slipid, a minute of them; `make fuzz` goes on for longer."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz import result_doors
from tests.fuzz.case import files_in, files_of_case
from tests.fuzz.door import Door
from tests.fuzz.doors import DOORS, door_of
from tests.fuzz.run import CORPUS, MOST_KEPT, Doorkeeper, Tally, corpus_of, shares, table, try_door
from tests.fuzz.traps import ENDLESS, TRAPS

COUNT = 6000
"""Cases over all doors."""


@pytest.fixture(scope="module")
def keeper(tmp_path_factory):
    keeper = Doorkeeper(tmp_path_factory.mktemp("doors"))
    yield keeper
    keeper.close()


def tried(door: Door, keeper: Doorkeeper, count: int, folder: Path) -> Tally:
    """Return the verdicts of cases and, as cases below 0, of the files that were kept."""
    tally = Tally(None, 0)
    again = try_door(door, keeper, tally, count, folder)
    assert not again, "\n".join(again)
    return tally


def of_door(door: Door):
    """A door as a parameter of a test."""
    slow = door in result_doors.FITS or door.name.startswith("exported")
    return pytest.param(door, id=door.name, marks=[pytest.mark.slow] if slow else [])


@pytest.mark.parametrize("door", [of_door(door) for door in DOORS])
def test_damaged_files_are_refused_in_one_sentence_or_read_right(door, keeper, tmp_path, request):
    if door in result_doors.FITS:
        keeper.out = request.getfixturevalue("sampled")[0]
    count = max(2, shares(DOORS, COUNT)[door.name])
    tally = tried(door, keeper, count, tmp_path)
    assert len(tally.rows[door.name]) == count
    assert not tally.causes(door.name), table(tally, [door])


def test_kept_files_belong_to_doors():
    folders = [path for path in CORPUS.iterdir() if path.is_dir()]
    assert {folder.name for folder in folders} <= {door.name for door in DOORS}
    kept = [one for door in DOORS for one in corpus_of(door)]
    assert kept
    assert all(target and path.stat().st_size <= MOST_KEPT for target, path in kept)


@pytest.mark.parametrize("trap", TRAPS, ids=lambda trap: trap.name)
def test_each_failure_has_its_verdict(trap, keeper, tmp_path):
    tally = Tally(tmp_path / "results", 0)
    try_door(trap, keeper, tally, 1, tmp_path / "kept")
    assert [row["verdict"] for row in tally.rows[trap.name]] == [trap.name]
    kept = [*(tmp_path / "kept").rglob("*.bin")]
    assert len(kept) == (trap.name != "refused")
    again = Tally(tmp_path / "results", 0)
    again.read()
    assert again.done(trap) == 1
    assert again.rows == tally.rows


def test_a_read_without_end_is_a_hang(tmp_path):
    keeper, tally = Doorkeeper(tmp_path, longest_s=0.5), Tally(None, 0)
    try:
        try_door(ENDLESS, keeper, tally, 1, tmp_path / "kept")
    finally:
        keeper.close()
    assert [row["verdict"] for row in tally.rows["endless"]] == ["hang"]


def test_a_case_follows_from_seed_door_and_number(tmp_path):
    door = door_of("times")
    door.make(tmp_path)
    files = files_in(tmp_path)
    first = [files_of_case(door, files, 1, k) for k in range(20)]
    assert first == [files_of_case(door, files, 1, k) for k in range(20)]
    assert len({data for _, data in first}) > 15
    assert first != [files_of_case(door, files, 2, k) for k in range(20)]
