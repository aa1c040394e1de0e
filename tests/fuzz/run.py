"""Damaged files at every door of slipid: are they refused in one clear sentence, or read right?

    python -m tests.fuzz.run                      # 100 000 cases over all doors
    python -m tests.fuzz.run --door NAME --count N --seed K
    python -m tests.fuzz.run --show NAME K        # writes the damaged file of a case

Case `k` of a door follows from the seed, the door and `k` alone. It is read in a process of its
own, with limits on CPU time and memory. Verdicts:

    accepted    read, and every number is finite
    refused     a `DataError` of at most 500 characters per mistake that names the input
    traceback   any other exception
    hang        more than 2 s of CPU time, or no end
    memory      more than 2 GB
    silent      read, although numbers are not finite or times do not increase
    outside     a file outside of the folder was written
    long        a line of more than 500 characters, or more than 21 lines
    nameless    a message that does not name the input
    crash       the process died

Verdicts are kept in `--results`, a file with a line of JSON per case, from which an interrupted run
goes on. Of failures with the same cause one damaged file is kept in `--kept`; those in
tests/fuzz/corpus are read first in every later run. The exit code is 0 where nothing failed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tests.fuzz.case import Verdict, files_in, files_of_case
from tests.fuzz.door import Door
from tests.fuzz.doors import DOORS

ROOT = Path(__file__).resolve().parents[2]
LONGEST_S = 20.0
"""Time on the clock after which a read is given up; much more than the CPU time that it may take,
since the machine may be shared."""

OUT = ROOT / ".cache" / "fuzz" / "out"
COMPILING = {
    "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache" / "jax"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    "JAX_PLATFORMS": "cpu",
}
"""Environment of the process, as in the suite: what is compiled is kept, and compiled fast."""
CORPUS = Path(__file__).with_name("corpus")
COUNT = 100_000
MOST_KEPT = 100_000
"""Bytes of the largest damaged file that is kept."""
_STACK = re.compile(r'File "[^"]*/(slipid/[^"]*)", line (\d+) in (\S+)')


@dataclass(eq=False)
class Doorkeeper:
    """A process that reads doors, started again when it dies.

    Attributes:
        scratch: folder of its own, for specimens and the files of cases.
        out: folder with the result of `slipid identify` and `sample`.
        longest_s: time on the clock after which a read is given up.
    """

    scratch: Path
    out: Path = OUT
    longest_s: float = LONGEST_S
    process: subprocess.Popen[str] | None = None
    door: Door | None = None

    def take(self, door: Door) -> None:
        """Take up a door; raise `RuntimeError` where its good specimen is not accepted."""
        self.door = door
        specimen = self.scratch / "specimens" / door.name
        if self.process is None:
            self.process = self._started()
        (answer,) = self._asked(["door", door.name, str(specimen), str(self.out)], 1)
        if "ready" not in answer:
            raise RuntimeError(answer.get("wrong", f"{door.name}: {answer}"))

    def cases(self, seed: int, first: int, last: int) -> Iterator[tuple[int, str, Verdict]]:
        """Yield number, target and verdict of cases; a case in which the process dies fails."""
        k = first
        while k < last:
            for answer in self._asked(["cases", seed, k, last], last - k):
                target, verdict = _of(answer)
                yield k, target, verdict
                k += 1
                if self.process is None:
                    assert self.door is not None
                    self.take(self.door)

    def file(self, target: str, path: Path) -> Verdict:
        """Return the verdict on a damaged file."""
        (answer,) = self._asked(["file", target, str(path)], 1)
        if self.process is None:
            assert self.door is not None
            self.take(self.door)
        return _of(answer)[1]

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self._ended()

    def _started(self) -> subprocess.Popen[str]:
        folder, temporary = self.scratch / "case", self.scratch / "temporary"
        temporary.mkdir(exist_ok=True)
        with (self.scratch / "stderr").open("w") as errors:
            return subprocess.Popen(
                [sys.executable, "-m", "tests.fuzz.worker", str(folder), str(self.longest_s)],
                cwd=ROOT,
                env={**COMPILING, **os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary)},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )

    def _asked(self, command: list[Any], count: int) -> Iterator[dict[str, Any]]:
        """Yield the answers to a command; the last one is of the process's end where it dies."""
        assert self.process is not None
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(command), file=self.process.stdin, flush=True)
        for _ in range(count):
            line = self.process.stdout.readline()
            if not line:
                yield self._end()
                return
            yield json.loads(line)

    def _ended(self) -> int:
        """Return the exit code of the process after its end."""
        assert self.process is not None
        self.process.communicate()
        code, self.process = self.process.returncode, None
        return code

    def _end(self) -> dict[str, Any]:
        """Return the answer in place of that of a process that died."""
        code = self._ended()
        text = (self.scratch / "stderr").read_text(errors="replace")
        stack = _STACK.search(text)
        place = f"{stack[1].removeprefix('slipid/')}:{stack[3]}" if stack else ""
        line = int(stack[2]) if stack else 0
        if "Timeout" in text:
            found = Verdict("hang", "timeout", place, line, seconds=self.longest_s)
        else:
            found = Verdict("crash", f"exit {code}", place, line, text[-300:])
        return asdict(found)


def _of(answer: dict[str, Any]) -> tuple[str, Verdict]:
    known = {k: v for k, v in answer.items() if k in Verdict.__dataclass_fields__}
    return answer.get("target", ""), Verdict(**known)


@dataclass(eq=False)
class Tally:
    """Verdicts of all cases, kept in a file.

    Attributes:
        path: the file.
        seed: of the run; verdicts of other seeds are left alone.
        rows: verdicts by door, one per case.
    """

    path: Path | None
    seed: int
    rows: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def read(self) -> None:
        """Take up the verdicts of an interrupted run; a line that is not whole ends them."""
        if self.path is None or not self.path.is_file():
            return
        for line in self.path.read_text(encoding="utf-8").splitlines():
            try:
                row = json.loads(line)
            except ValueError:
                continue
            if row["seed"] == self.seed:
                self.rows.setdefault(row["door"], []).append(row)

    def done(self, door: Door) -> int:
        """Return the number of the first case of a door that has no verdict."""
        return 1 + max((row["k"] for row in self.rows.get(door.name, [])), default=-1)

    def add(self, door: Door, k: int, target: str, found: Verdict) -> None:
        """Keep a verdict."""
        row: dict[str, Any] = {"seed": self.seed, "door": door.name, "k": k}
        row |= {"verdict": found.verdict, "s": found.seconds, "mb": found.megabytes}
        if found.failed:
            row |= {"kind": found.kind, "place": found.place, "line": found.line}
            row |= {"target": target, "message": found.message}
        self.rows.setdefault(door.name, []).append(row)
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")

    def causes(self, door: str) -> dict[tuple[str, ...], list[dict[str, Any]]]:
        """Return the failures of a door by their cause."""
        found: dict[tuple[str, ...], list[dict[str, Any]]] = {}
        for row in self.rows.get(door, []):
            if "kind" in row:
                key = (row["verdict"], row["kind"], row["place"])
                found.setdefault(key, []).append(row)
        return found


def kept_name(target: str, found: Verdict) -> str:
    """Return the name under which a damaged file is kept: its cause, then that of the file."""
    mark = hashlib.sha256(found.signature.encode()).hexdigest()[:8]
    kind = re.sub(r"\W+", "_", found.kind)[:24].strip("_")
    return f"{found.verdict}-{kind}-{mark}.{target.replace('/', '+')}"


def corpus_of(door: Door) -> list[tuple[str, Path]]:
    """Return the kept files of a door with the names of the files in whose place they are read."""
    folder = CORPUS / door.name
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    return [(path.name.partition(".")[2].replace("+", "/"), path) for path in paths]


def shares(doors: Sequence[Door], count: int) -> dict[str, int]:
    """Return the number of cases of each door, at least `count` in total, by weight."""
    whole = sum(door.weight for door in doors)
    return {door.name: math.ceil(count * door.weight / whole) for door in doors}


def try_door(
    door: Door, keeper: Doorkeeper, tally: Tally, count: int, kept: Path, until: float = math.inf
) -> list[str]:
    """Read the kept files of a door, then its cases.

    Args:
        door: the door.
        keeper: the process that reads.
        tally: verdicts of the cases before, to which those of these are added.
        count: number of cases.
        kept: folder for damaged files of new failures.
        until: time at which to stop, on the clock of `time.monotonic`.

    Returns:
        A line about each kept file that fails.
    """
    keeper.take(door)
    again, known = [], set()
    for target, path in corpus_of(door):
        found = keeper.file(target, path)
        known.add(path.name)
        if found.failed:
            again.append(f"{path}: {found.signature}: {found.message[:100]}")
    specimen = files_in(keeper.scratch / "specimens" / door.name)
    for k, target, found in keeper.cases(tally.seed, tally.done(door), count):
        name, data = files_of_case(door, specimen, tally.seed, k) if found.failed else (target, b"")
        tally.add(door, k, name, found)
        if found.failed and kept_name(name, found) not in known and len(data) <= MOST_KEPT:
            known.add(kept_name(name, found))
            (kept / door.name).mkdir(parents=True, exist_ok=True)
            (kept / door.name / kept_name(name, found)).write_bytes(data)
        if time.monotonic() > until:
            keeper.close()
            break
    return again


def table(tally: Tally, doors: Sequence[Door]) -> str:
    """Return the counts of each door, and a line about each cause of failures."""
    lines = []
    for door in doors:
        rows = tally.rows.get(door.name, [])
        counts = Counter(row["verdict"] for row in rows)
        if rows:
            slow, big = max(row["s"] for row in rows), max(row["mb"] for row in rows)
            words = ", ".join(f"{n} {name}" for name, n in sorted(counts.items()))
            lines.append(f"{door.name:20} {len(rows):6} cases: {words}; {slow:.2f} s, {big:.0f} MB")
        for (verdict, kind, place), some in tally.causes(door.name).items():
            one = some[0]
            lines.append(
                f"    {verdict} {kind} {place}:{one['line']} x{len(some)}, such as case {one['k']} "
                f"({one['target']}): {one['message'][:160]!r}"
            )
    return "\n".join(lines)


def show(door: Door, k: int, seed: int) -> None:
    """Write the damaged file of a case to the working folder."""
    with tempfile.TemporaryDirectory() as folder:
        door.make(Path(folder))
        name, data = files_of_case(door, files_in(Path(folder)), seed, k)
    Path(Path(name).name).write_bytes(data)
    print(f"{Path(name).name}: {len(data)} bytes in place of {name}")


def main(words: Sequence[str] | None = None) -> int:
    """Run the cases that the options name; return 0 where none fails."""
    parser = argparse.ArgumentParser(description="damaged files at every door of slipid")
    parser.add_argument("--door", action="append", choices=[door.name for door in DOORS])
    parser.add_argument("--count", type=int, default=COUNT, help="cases over all doors")
    parser.add_argument("--seconds", type=float, default=math.inf, help="stop after this time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--results", type=Path, default=None)
    parser.add_argument("--kept", type=Path, default=CORPUS, help="folder for damaged files")
    parser.add_argument("--show", nargs=2, metavar=("DOOR", "K"))
    options = parser.parse_args(words)
    if options.show:
        name, k = options.show
        show(next(door for door in DOORS if door.name == name), int(k), options.seed)
        return 0
    doors = [door for door in DOORS if not options.door or door.name in options.door]
    tally, counts = Tally(options.results, options.seed), shares(doors, options.count)
    tally.read()
    until = time.monotonic() + options.seconds
    scratch = Path(tempfile.mkdtemp(prefix="fuzz-"))
    ahead = list(reversed(doors))
    again: list[str] = []

    def work(number: int) -> None:
        folder = scratch / str(number)
        folder.mkdir()
        keeper = Doorkeeper(folder)
        while ahead and time.monotonic() < until:
            door = ahead.pop()
            try:
                again.extend(try_door(door, keeper, tally, counts[door.name], options.kept, until))
            except RuntimeError as error:
                again.append(str(error))
            print(table(tally, [door]), flush=True)
        keeper.close()

    try:
        with ThreadPoolExecutor(options.workers) as pool:
            list(pool.map(work, range(options.workers)))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    missing = [door.name for door in doors if tally.done(door) < counts[door.name]]
    rows = [row for door in doors for row in tally.rows.get(door.name, [])]
    failed = sum("kind" in row for row in rows)
    print(*again, sep="\n")
    print(f"{len(rows)} cases, {failed} failed; {len(again)} other lines above")
    if missing:
        print(f"not done: {', '.join(missing)}")
    return int(bool(failed or again))


if __name__ == "__main__":
    sys.exit(main())
