"""Published formats: which of them files are of."""

from dataclasses import dataclass

from slipid.data.reading.layout import Layout
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.reader import read_logs
from slipid.data.sanity.columns import refuse_misordered
from slipid.job.new.look.files.file import Head
from slipid.job.new.look.files.kinds import Kind
from slipid.support.errors import DataError

_TELLING = 8
"""Named columns from which nobody else will have the same by chance."""
_TRIED = 3
"""Files that are read to see whether a preset fits."""


@dataclass(frozen=True)
class Likely:
    """Presets that a kind of files can be read with.

    Attributes:
        sure: that which uses most of their columns, if its names are telling.
        perhaps: others, whose columns anybody could have.
    """

    sure: str | None
    perhaps: tuple[str, ...]


def likely_presets(kind: Kind) -> Likely:
    """Presets that read the first files of a kind."""
    fits = [name for name, layout in PRESETS.items() if _matches(kind.heads[0], layout)]
    fits = [name for name in fits if _reads(kind, PRESETS[name])]
    fits.sort(key=lambda name: len(PRESETS[name].columns), reverse=True)
    telling = [name for name in fits if PRESETS[name].names_row and _many(PRESETS[name])]
    sure = telling[0] if telling else None
    return Likely(sure, tuple(name for name in fits if name not in telling))


def _many(layout: Layout) -> bool:
    return len(layout.columns) >= _TELLING


def _matches(head: Head, layout: Layout) -> bool:
    """Whether names and numbers stand where a layout says."""
    rows = (layout.delimiter, layout.names_row, layout.first_data_row)
    if rows != (head.delimiter, head.names_row, head.first_data_row):
        return False
    if not layout.names_row:
        return len(head.names) == 1 + max(int(column) for column in layout.columns)
    return set(layout.columns) <= set(head.names)


def _reads(kind: Kind, layout: Layout) -> bool:
    for path in kind.paths[:_TRIED]:
        try:
            refuse_misordered(read_logs(path, layout, path.parent, "floor", "as_built").logs)
        except DataError:
            continue
        return True
    return False
