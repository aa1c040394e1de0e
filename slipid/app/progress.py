"""What a running command tells people, on stderr: a bar on a terminal, plain lines elsewhere."""

import math
import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn


class Reporter:
    """Progress of reading and fitting; use as a context.

    Args:
        tolerance: of the fit; tells how much of the way is done.
        quiet: only warnings.
    """

    def __init__(self, tolerance: float = 0.02, quiet: bool = False):
        self.console = Console(stderr=True, highlight=False)
        self.tolerance, self.quiet = tolerance, quiet
        self._bars: Progress | None = None
        self._task: Any = None
        self._moved: list[tuple[float, float]] = []
        self._stage = ""
        self._part, self._since = "", time.monotonic()

    def __enter__(self) -> "Reporter":
        if self.console.is_terminal and not self.quiet:
            self._bars = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                TextColumn("{task.fields[what]}"),
                TimeElapsedColumn(),
                console=self.console,
                transient=True,
            )
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()
            self._bars = None

    def line(self, text: str) -> None:
        """One sentence, above the bar."""
        if not self.quiet:
            self.console.print(text, markup=False, soft_wrap=True)

    def stage(self, name: str) -> None:
        """A new part of the work begins."""
        if name == self._stage:
            return
        self._stage, self._moved, self._part, self._since = name, [], "", time.monotonic()
        if self._bars is None:
            self.line(f"{name} ...")
            return
        if self._task is not None:
            self._bars.remove_task(self._task)
        self._task = self._bars.add_task(name, total=None, what="")

    def count(self, done: int, total: int) -> None:
        """So many of so many."""
        if self._bars is not None and self._task is not None:
            self._bars.update(self._task, completed=done, total=total, what=f"{done} of {total}")

    def round(self, state: Any) -> None:
        """A round of one of many fits is done."""
        if self._bars is not None and self._task is not None:
            self._bars.update(self._task, what=f"{self._part}, {state.stage}, round {state.round}")

    def part(self, done: int, total: int) -> None:
        """So many of so many equal parts are done; the rest takes as long as the last one each."""
        now = time.monotonic()
        left = (now - self._since) * (total - done)
        self._since = now
        self._part = f"{done} of {total}" + (f", about {left:.0f} s left" if done < total else "")
        if self._bars is None:
            self.line(f"  {self._part}")
        else:
            self._bars.update(self._task, completed=done, total=total, what=self._part)

    def step(self, done: int, total: int, what: str) -> None:
        """So many of so many are done; elsewhere than on a terminal a line now and then."""
        if self._bars is not None and self._task is not None:
            text = f"{done} of {total}, {what}"
            self._bars.update(self._task, completed=done, total=total, what=text)
        elif done == total or done % max(1, total // 10) == 0:
            self.line(f"  {done} of {total}, {what}")

    def point(self, done: int, rise: float) -> None:
        """A point of a profile is fitted."""
        if self._bars is not None and self._task is not None:
            self._bars.update(self._task, what=f"{done} points, rise {rise:.2f}")

    def beside(self, text: str) -> None:
        """What is going on at this moment, on the bar of a terminal only."""
        if self._bars is not None and self._task is not None:
            self._bars.update(self._task, what=text)

    def state(self, state: Any) -> None:
        """A round of the fit is done."""
        self.stage(state.stage)
        self._moved.append((time.monotonic(), max(state.moved, 1e-12)))
        left = self._left()
        what = f"round {state.round}, loss {state.loss:.2f}, moved {state.moved:.3g} std"
        if left is not None:
            what += f", about {left:.0f} s left"
        if self._bars is None:
            self.line(f"  {what}")
        else:
            seconds = self._moved[-1][0] - self._moved[0][0]
            total = None if left is None else seconds + left
            self._bars.update(self._task, completed=seconds, total=total, what=what)

    def _left(self) -> float | None:
        """Seconds until the steps are below the tolerance, if they go on shrinking as they do."""
        if len(self._moved) < 4 or self._stage != "joint":
            return None
        (t0, m0), (t1, m1) = self._moved[-4], self._moved[-1]
        if m1 <= self.tolerance:
            return 0.0
        rate = math.log(m0 / m1) / (t1 - t0) if t1 > t0 else 0.0
        return math.log(m1 / self.tolerance) / rate if rate > 0 else None
