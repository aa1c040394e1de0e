"""Progress of long jobs, reported on stderr: by a bar on a terminal, by plain lines elsewhere."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Task, TaskID, TimeRemainingColumn
    from rich.text import Text

COMPILING_S = 15.0
"""Usual time in which the functions of a fit are compiled, on two cores [s]."""
Tell = Callable[[int, int], None]
"""Function that is called with the finished and the total number of steps of a stage."""


def silent(done: int, total: int) -> None:
    """Report no progress."""


LINE_PERIOD_S = 2.0
"""Shortest time between two plain lines about one stage [s]."""
AVERAGING_S = 3600.0
"""Time over which the speed of progress is averaged for the remaining time [s]; it is long, since a
step of a fit may take minutes."""


class Reporter:
    """Reporter of the progress of a job, used as a context manager; silent if `quiet`."""

    def __init__(self, quiet: bool = False):
        # Rich is imported here because every command imports this module, and `--help` needs no
        # progress bar.
        from rich import progress as bars
        from rich.console import Console

        self._console = Console(stderr=True, highlight=False, quiet=quiet)
        self._bars = bars.Progress(
            bars.TextColumn("{task.description}"),
            bars.BarColumn(bar_width=24),
            bars.TextColumn("{task.fields[what]}"),
            bars.TimeElapsedColumn(),
            _time_left(),
            console=self._console,
            transient=True,
            speed_estimate_period=AVERAGING_S,
            # Without a terminal the bar is not shown, and only computes the remaining time.
            disable=quiet or not self._console.is_terminal,
        )
        self._task: "TaskID | None" = None
        self._stage, self._reported = "", 0.0

    def __enter__(self) -> "Reporter":
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def line(self, text: str) -> None:
        """Print a sentence, which stays on the terminal above the bar."""
        self._console.print(text, markup=False, soft_wrap=True)

    def stage(self, name: str, usual_s: float | None = None) -> None:
        """Start a stage of the job, unless it is the current one.

        Args:
            name: what is done, such as "reading logs".
            usual_s: usual duration where most of it is the compilation of functions, which is not
                needed again, and whose progress is not known [s].
        """
        if name == self._stage:
            return
        if self._task is not None:
            self._bars.remove_task(self._task)
        self._task = self._bars.add_task(name, total=None, what="", usual_s=usual_s)
        self._stage, self._reported = name, time.monotonic()
        if self._bars.disable:
            usual = "" if usual_s is None else f" (the first time usually {usual_s:.0f} s)"
            self.line(f"{name} ...{usual}")

    def note(self, what: str) -> None:
        """Show a text about the current activity next to the bar; without a bar, do nothing."""
        if self._task is not None:
            self._bars.update(self._task, what=what)

    def steps(self, done: int, total: int) -> None:
        """Report the progress of the current stage without a text about it."""
        self.advance(done, total, f"{100 * done / max(total, 1):.0f} %")

    def advance(self, done: int | float, total: int | float, what: str | None = None) -> None:
        """Report the progress of the current stage.

        Without a terminal a line is printed at most every `LINE_PERIOD_S`, and at the end of the
        stage.

        Args:
            done, total: finished and total amount of work in any unit; the total may be estimated
                anew during a stage.
            what: text about the progress, `done of total` by default.
        """
        if self._task is None:
            return
        what = f"{done} of {total}" if what is None else what
        self._bars.update(self._task, completed=done, total=total, what=what)
        now = time.monotonic()
        if not self._bars.disable or (now < self._reported + LINE_PERIOD_S and done < total):
            return
        self._reported = now
        left = next(task for task in self._bars.tasks if task.id == self._task).time_remaining
        self.line(f"  {what}" + (f", about {left:.0f} s left" if left else ""))


def _time_left() -> "TimeRemainingColumn":
    """Return the column with the remaining time, by the usual one before progress is known."""
    from rich.progress import TimeRemainingColumn
    from rich.text import Text

    class TimeLeft(TimeRemainingColumn):
        def render(self, task: "Task") -> "Text":
            usual = task.fields["usual_s"]
            if usual is None or task.elapsed is None or task.time_remaining is not None:
                return super().render(task)
            left = max(usual - task.elapsed, 0.0)
            return Text(f"{left // 60:.0f}:{left % 60:02.0f}", style="progress.remaining")

    return TimeLeft()
