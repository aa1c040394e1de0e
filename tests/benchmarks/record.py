"""Tables of the documentation, which benchmarks write: SLIPID_RECORD=1 renews `docs/results`.

A results file has the title, the command and the columns of a table; a benchmark replaces its rows,
and with them the date, the machine and the version of slipid.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Sequence
from datetime import date
from pathlib import Path

import slipid
from tests.benchmarks.quick import QUICK

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
Cell = str | float | None | Sequence[float]
"""A cell of a table: text, a number, a number with its interval (a list of three), or nothing."""


def record(name: str, rows: Iterable[Sequence[Cell]], keys: int = 1) -> None:
    """Replace rows of a table if SLIPID_RECORD is set and this is not the quick form.

    Args:
        name: name of the file in `docs/results`, without `.json`.
        rows: measured rows. A row replaces the one whose first cells are the same, or is added.
        keys: number of these first cells.
    """
    if os.environ.get("SLIPID_RECORD", "") in ("", "0") or QUICK:
        return
    path = RESULTS / f"{name}.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    table = {tuple(row[:keys]): row for row in content["rows"]}
    for row in rows:
        if len(row) != len(content["columns"]):
            raise ValueError(f"{name}: a row of {len(row)} cells; expected {content['columns']}")
        table[tuple(row[:keys])] = list(row)
    content |= {
        "date": date.today().isoformat(),
        "machine": f"{os.cpu_count()}-core {platform.machine()}",
        "slipid": slipid.__version__,
        "rows": list(table.values()),
    }
    path.write_text(written(content), encoding="utf-8")


def written(content: dict) -> str:
    """Return the text of a results file, with a line for each row."""
    head = json.dumps({**content, "rows": []}, indent=1, ensure_ascii=False)
    lines = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in content["rows"])
    return head.replace('"rows": []', f'"rows": [\n{lines}\n ]') + "\n"
