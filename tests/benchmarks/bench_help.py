"""Time of `slipid --help` beside that of importing typer, in processes of their own, by turns."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

from tests.benchmarks.quick import QUICK, quick

TYPER = (sys.executable, "-c", "import typer")
HELP = (sys.executable, "-c", "from slipid.cli.main import main; main()", "--help")


def seconds(words):
    began = time.perf_counter()
    subprocess.run(words, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began


def test_help_takes_at_most_1_6_times_the_import_of_typer():
    for words in (TYPER, HELP):  # bytecode is written
        seconds(words)
    pairs = [(seconds(TYPER), seconds(HELP)) for _ in range(quick(20, 2))]
    ratio = statistics.median(whole / part for part, whole in pairs)
    each = (1000 * statistics.median(times) for times in zip(*pairs, strict=True))
    print("\nimport typer {:.0f} ms, slipid --help {:.0f} ms".format(*each), end="")
    print(f", median ratio of {len(pairs)} pairs {ratio:.2f}")
    assert QUICK or ratio <= 1.6
