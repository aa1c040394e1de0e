"""The process in which doors are read: a line of JSON per command, and one per case.

Commands on standard input: `["door", NAME, SPECIMEN, OUT]`, then `["cases", SEED, FIRST, LAST]` or
`["file", TARGET, PATH]`. The process ends by itself when a read takes too long on the clock, and
leaves the stack of the read in its standard error.
"""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import shutil
import sys
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any


def main() -> None:
    """Read commands until there are no more."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    folder = Path(sys.argv[1])
    sys.dont_write_bytecode = True
    warnings.simplefilter("ignore")
    os.environ["MPLBACKEND"] = "Agg"
    import jax

    jax.config.update("jax_enable_x64", True)
    from tests.fuzz.case import Watch

    reader = Reader(folder, Watch(), float(sys.argv[2]))
    for line in sys.stdin:
        word, *values = json.loads(line)
        for answer in getattr(reader, f"do_{word}")(*values):
            print(json.dumps(answer), file=answers, flush=True)


class Reader:
    """A door that is being read, with its specimen in the working folder."""

    def __init__(self, folder: Path, watch: Any, longest_s: float) -> None:
        self.folder, self.watch, self.longest_s = folder.resolve(), watch, longest_s
        self.door: Any = None
        self.specimen: dict[str, bytes] = {}

    def do_door(self, name: str, specimen: str, out: str) -> list[Any]:
        """Take up a door, whose good specimen is made where it is absent and must be accepted."""
        from tests.fuzz import result_doors
        from tests.fuzz.case import files_in, read, targets_of
        from tests.fuzz.doors import door_of

        self._limit(None)
        result_doors.OUT = Path(out)
        self.door = door_of(name)
        if not Path(specimen).is_dir():
            Path(specimen).mkdir(parents=True)
            self.door.make(Path(specimen))
        self.specimen = files_in(Path(specimen))
        self._lay_out()
        for target in targets_of(self.door, self.specimen)[:6]:
            for _ in range(2):
                found = read(self.door, target, self.specimen, self.watch)
            if found.verdict != "accepted":
                return [{"wrong": f"{name}: the good {target}: {found}"}]
        self._limit(2 << 30)
        return [{"ready": name}]

    def do_cases(self, seed: int, first: int, last: int) -> Any:
        """Yield the verdicts of numbered cases."""
        from tests.fuzz.case import files_of_case

        for k in range(first, last):
            name, data = files_of_case(self.door, self.specimen, seed, k)
            yield {"k": k, "target": name, **asdict(self._verdict(name, data))}

    def do_file(self, target: str, path: str) -> Any:
        """Yield the verdict on a damaged file that was kept."""
        yield {"target": target, **asdict(self._verdict(target, Path(path).read_bytes()))}

    def _verdict(self, name: str, data: bytes) -> Any:
        from tests.fuzz.case import read

        files = {**self.specimen, name: data}
        files = self.door.seal(files) if self.door.seal else files
        changed = {n: d for n, d in files.items() if self.specimen.get(n) != d}
        for name_, content in changed.items():
            (self.folder / name_).write_bytes(content)
        faulthandler.dump_traceback_later(self.longest_s, exit=True)
        found = read(self.door, name, files, self.watch)
        if found.verdict == "hang":  # what was compiled or imported for the first time is not slow
            found = read(self.door, name, files, self.watch)
        faulthandler.cancel_dump_traceback_later()
        if found.verdict == "outside" or set(self._there()) != set(files):
            self._lay_out()
        for name_ in changed:
            if name_ in self.specimen:
                (self.folder / name_).write_bytes(self.specimen[name_])
            else:
                (self.folder / name_).unlink(missing_ok=True)
        return found

    def _there(self) -> list[str]:
        return [
            os.path.relpath(os.path.join(base, name), self.folder)
            for base, _, names in os.walk(self.folder)
            for name in names
        ]

    def _lay_out(self) -> None:
        os.chdir("/")
        shutil.rmtree(self.folder, ignore_errors=True)
        for name, data in self.specimen.items():
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / name).write_bytes(data)
        os.chdir(self.folder)

    def _limit(self, more: int | None) -> None:
        """Limit the address space to what there is now and `more` bytes."""
        now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        soft = resource.RLIM_INFINITY if more is None else now + more
        resource.setrlimit(resource.RLIMIT_AS, (soft, resource.RLIM_INFINITY))


if __name__ == "__main__":
    main()
