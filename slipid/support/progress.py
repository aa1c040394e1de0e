"""Progress of long jobs, reported on stderr: by a bar on a terminal, by plain lines elsewhere."""

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import TaskID

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
            bars.TimeRemainingColumn(),
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

    def stage(self, name: str) -> None:
        """Start a stage of the job, unless it is the current one."""
        if name == self._stage:
            return
        if self._task is not None:
            self._bars.remove_task(self._task)
        self._task = self._bars.add_task(name, total=None, what="")
        self._stage, self._reported = name, time.monotonic()
        if self._bars.disable:
            self.line(f"{name} ...")

    def note(self, what: str) -> None:
        """Show a text about the current activity next to the bar; without a bar, do nothing."""
        if self._task is not None:
            self._bars.update(self._task, what=what)

    def advance(self, done: int | float, total: int | float, what: str | None = None) -> None:
        """Report the progress of the current stage.

        Without a terminal a line is printed at most every `LINE_PERIOD_S`, and at the end of the
        stage.

        Args:
            done, total: finished and total amount of work in any unit; the total is constant
                throughout a stage.
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
