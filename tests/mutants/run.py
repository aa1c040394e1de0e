"""Faults planted in the package one by one: which of them do tests notice?

    python tests/mutants/run.py                      # mutants that have no result yet
    python tests/mutants/run.py NAME... --again      # these, whether they have one or not
    python tests/mutants/run.py --check              # only whether texts and tests are there
    python tests/mutants/run.py --sound              # their tests without any fault
    python tests/mutants/run.py --survivors --suite  # those that survived, on the whole suite

A mutant of `mutants.toml` is one short text of one file of the package, and the wrong text in its
place. It runs in a copy of the repository on the tests of its room, one entry of `tests` after the
other, those that should notice it first, up to the first failure:

    killed      a test failed, or its module does not come through with what the package made of it
    survived    all passed: a test is missing, or `survives` says why there can be none
    timeout     an entry took longer than `--timeout` [s]
    error       nothing is known: a text or a test is not there, or could not be imported

`file` is a path below `slipid/`. Where its text is not there, the one file of the package that has
it is taken, and that is said; tests whose file was moved are found by its name. Only a text that
has itself changed is to be written anew. Results are kept in `--results`, a JSON file; mutants that
have one are skipped, but for errors. The last lines list what was not killed, with the explanation,
count the mutants of every room, and give the share that was killed. The exit code is 0 where every
survivor of those that were asked for has an explanation, and at least 90 % of them are killed.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = shutil.ignore_patterns(".*", "__pycache__", "demo_out", "out")
VERDICTS = {0: "survived", 1: "killed", 2: "killed"}
"""By exit code of pytest; any other one is an error."""
BROKEN = re.compile(
    r"(?!FAILED|ERROR )|ERROR (?!\S*::|.* - )"
    r"|.*(ImportError|ModuleNotFoundError|fixture '\w+' not found)"
)
"""Lines of what was not found, imported or set up: no failure of a test."""
LEAST_KILLED = 0.9
"""Smallest share of mutants that tests have to notice."""


@dataclass(frozen=True)
class Mutant:
    """A fault: the old text of a file, the new one, and the tests that should notice.

    `survives` says why no test can notice, or none should.
    """

    name: str
    file: str
    old: str
    new: str
    tests: Sequence[str]
    survives: str = ""


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant of a file: a verdict, after how long [s], and what was said last."""

    name: str
    verdict: str
    seconds: float
    file: str
    by: str


def read() -> dict[str, Mutant]:
    """All mutants by name."""
    rows = tomllib.loads(Path(__file__).with_name("mutants.toml").read_text(encoding="utf-8"))
    found = {row["name"]: Mutant(**row) for row in rows["mutant"]}
    if len(found) < len(rows["mutant"]):
        raise ValueError("mutants.toml: a name is there twice")
    return found


def place_of(mutant: Mutant, package: Path) -> Path:
    """The file that has the old text, once; ValueError where there is none or several."""
    given = package / mutant.file
    times = {p: p.read_text(encoding="utf-8").count(mutant.old) for p in package.rglob("*.py")}
    there = {p: n for p, n in times.items() if n and (p == given or not times.get(given))}
    if [*there.values()] != [1]:
        known = {str(p.relative_to(package)): n for p, n in there.items()}
        raise ValueError(f"{mutant.name}: {mutant.old!r} expected once; it is there {known}")
    (found,) = there
    if found != given:
        print(f"{mutant.name}: {mutant.file} is {found.relative_to(package)} now")
    return found


def tests_of(mutant: Mutant, root: Path) -> list[str]:
    """Its tests where they are now; ValueError where a file is not there, or several are."""
    out = []
    for test in mutant.tests:
        path, *inside = test.split("::")
        named = root.glob(f"tests/**/{Path(path).name}")
        has = "".join(f"def {name}(" for name in inside)
        there = [p for p in named if p.is_dir() or has in p.read_text(encoding="utf-8")]
        there = [root / path] if (root / path).exists() else there
        if len(there) != 1:
            raise ValueError(f"{mutant.name}: {len(there)} files {path}; expected one")
        out.append("::".join([str(there[0].relative_to(root)), *inside]))
    return out


def tested(tree: Path, tests: Sequence[str], timeout: float) -> tuple[str, str]:
    """Verdict of tests in a copy of the repository, and what was said last."""
    env = {
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache" / "jax"),
        "SLIPID_DATA": str(ROOT.parent / "shared" / "data"),
        **os.environ,
        "PYTHONPATH": str(tree),
        "COLUMNS": "300",  # reasons of errors are not cut off
    }
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    try:
        run = subprocess.run(
            command, cwd=tree, env=env, timeout=timeout, capture_output=True, text=True, check=False
        )
    except subprocess.TimeoutExpired:
        return "timeout", " ".join(tests)
    said = re.search(r"^(FAILED|ERROR) .*", run.stdout + run.stderr, re.M)
    by = said.group() if said else run.stdout.strip()[-200:]
    verdict = VERDICTS.get(run.returncode, "error")
    return ("error" if verdict == "killed" and BROKEN.match(by) else verdict), by


def outcome(mutant: Mutant, tree: Path, options: argparse.Namespace) -> Outcome:
    """What becomes of a mutant in a copy of the repository, which it leaves as it was."""
    began, verdict, by = time.monotonic(), "survived", ""
    try:
        path, tests = place_of(mutant, tree / "slipid"), tests_of(mutant, tree)
    except ValueError as error:
        return Outcome(mutant.name, "error", 0.0, mutant.file, str(error))
    plain, times = path.read_text(encoding="utf-8"), path.stat()
    path.write_text(plain.replace(mutant.old, mutant.new), encoding="utf-8")
    try:
        for test in ["tests"] if options.suite else tests:
            verdict, by = tested(tree, [test], options.timeout)
            if verdict != "survived":
                break
    finally:
        path.write_text(plain, encoding="utf-8")
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    took = round(time.monotonic() - began, 1)
    return Outcome(mutant.name, verdict, took, str(path.relative_to(tree / "slipid")), by)


def run(some: Sequence[Mutant], kept: dict[str, Outcome], options: argparse.Namespace) -> None:
    """Add outcomes to those that are kept; each is in the file as soon as it is known."""
    free: SimpleQueue[Path] = SimpleQueue()

    def one(mutant: Mutant) -> Outcome:
        tree = free.get()
        try:
            return outcome(mutant, tree, options)
        finally:
            free.put(tree)

    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as pool:
        for k in range(options.jobs):
            free.put(Path(shutil.copytree(ROOT, Path(folder) / str(k), ignore=LEFT_OUT)))
        for task in as_completed([pool.submit(one, mutant) for mutant in some]):
            o = kept[task.result().name] = task.result()
            options.results.parent.mkdir(parents=True, exist_ok=True)
            options.results.write_text(json.dumps([asdict(o) for o in kept.values()], indent=1))
            print(f"{o.verdict:8} {o.seconds:6.1f} s  {o.name}  {o.by[:150]}", flush=True)


def check(some: Sequence[Mutant]) -> int:
    """Print of which mutants texts or tests are not there; how many."""
    bad = 0
    for mutant in some:
        try:
            place_of(mutant, ROOT / "slipid"), tests_of(mutant, ROOT)
        except ValueError as error:
            print(error)
            bad += 1
    print(f"{len(some) - bad} of {len(some)} mutants have their text and tests")
    return bad


def sound(some: Sequence[Mutant], timeout: float) -> str:
    """Verdict of the tests of mutants without any fault, which is `survived` if they are sound."""
    tests = dict.fromkeys(test for mutant in some for test in tests_of(mutant, ROOT))
    verdict, by = tested(ROOT, [*tests], timeout)
    print(verdict, by)
    return verdict


def summary(some: Sequence[Mutant], kept: Mapping[str, Outcome]) -> bool:
    """Print what was not killed, and counts of every room; True if that is good enough."""
    verdicts = {m.name: kept[m.name].verdict for m in some}
    print("\nnot killed:" if set(verdicts.values()) - {"killed"} else "")
    for m in some:
        if verdicts[m.name] != "killed":
            print(f"  {verdicts[m.name]:8} {m.name}: {m.survives or 'no explanation'}")
    rooms = Counter((m.file.split("/")[0], verdicts[m.name]) for m in some)
    kinds = [v for v in ("killed", "survived", "timeout", "error") if v in verdicts.values()]
    for room in sorted({room for room, _ in rooms}):
        print(f"{room:16}", ", ".join(f"{rooms[room, v]:3} {v}" for v in kinds if rooms[room, v]))
    killed = [*verdicts.values()].count("killed") / max(len(some), 1)
    print(f"{len(some)} mutants, {100 * killed:.1f} % killed")
    left = [m for m in some if verdicts[m.name] != "killed" and not m.survives]
    return killed >= LEAST_KILLED and not left


def main() -> int:
    """Do what is asked for."""
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("names", nargs="*")
    for switch in ("check", "sound", "again", "survivors", "suite"):
        parser.add_argument(f"--{switch}", action="store_true")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--timeout", type=float, default=900.0)
    parser.add_argument("--results", type=Path, default=ROOT / ".cache" / "mutants.json")
    options = parser.parse_args()
    every = read()
    if unknown := set(options.names) - set(every):
        parser.error(f"no mutant {sorted(unknown)[0]}; mutants.toml has their names")
    some = [every[name] for name in options.names or every]
    if options.check or options.sound:
        bad = check(some) > 0 or (options.sound and sound(some, options.timeout) != "survived")
        return int(bad)
    kept: dict[str, Outcome] = {}
    if options.results.exists():
        rows = json.loads(options.results.read_text(encoding="utf-8"))
        kept = {row["name"]: Outcome(**row) for row in rows}
    if options.survivors:
        some = [m for m in some if m.name in kept and kept[m.name].verdict == "survived"]
    done = {n for n, o in kept.items() if o.verdict != "error"}
    again = options.again or options.survivors
    run([m for m in some if again or m.name not in done], kept, options)
    return int(not summary(some, kept))


if __name__ == "__main__":
    sys.exit(main())
