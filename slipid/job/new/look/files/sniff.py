"""Where names, units and numbers stand in the lines of a text file."""

from collections import Counter

from slipid.job.new.look.columns.names import is_unit

_DELIMITERS = (",", ";", "\t", "|", " ")
HEAD = 60
"""Lines that are looked at for the header."""
EMPTY = {"", "nan", "na", "n/a", "null", "none"}


def cells_of(line: str, delimiter: str) -> list[str]:
    """Cells of a line, without blanks and quotes around them."""
    return [cell.strip().strip("\"'").strip() for cell in line.split(delimiter)]


def number_in(cell: str) -> float | None:
    """The number in a cell; None where it holds something else."""
    try:
        return float(cell) if "_" not in cell else None
    except ValueError:
        return None


def delimiter_of(lines: list[str]) -> str:
    """The character that is in most lines the same number of times; most times, if several are."""

    def score(delimiter: str) -> tuple[float, int]:
        counts = Counter(line.count(delimiter) for line in lines[:HEAD] if line.strip())
        count, times = counts.most_common(1)[0]
        return (times / sum(counts.values()) if count else 0.0, count)

    best = max(_DELIMITERS[:-1], key=score)
    if score(best)[1]:
        return best
    return " " if score(" ")[1] and score(" ")[0] > 0.5 else ","


def first_numbers(rows: list[list[str]]) -> int | None:
    """Place of the first row that holds numbers and nothing else, or nearly."""
    usual = Counter(len(row) for row in rows).most_common(1)[0][0]
    for k, row in enumerate(rows):
        filled = [cell for cell in row if cell.lower() not in EMPTY]
        numbers = sum(number_in(cell) is not None for cell in filled)
        if len(row) >= usual - 1 and numbers > 0.5 * len(filled):
            return k
    return None


def header_rows(rows: list[list[str]], width: int) -> tuple[int, int]:
    """Rows of names and of units, counted from 1, 0 where there is none."""
    names = units = 0
    for k, row in enumerate(rows, start=1):
        filled = [cell for cell in row if cell]
        if len(row) < width - 1 or len(filled) < len(row) - 2:
            continue
        if sum(map(is_unit, filled)) > 0.5 * len(filled) and not all(len(c) == 1 for c in filled):
            units = k
        elif sum(number_in(cell) is None for cell in filled) > 0.5 * len(filled):
            names = k
    return (names, units) if names else (0, 0)
