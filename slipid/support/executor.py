"""Work given to an executor: this process, or processes that end with whoever started them.

Who has work to spread takes a `concurrent.futures.Executor`, so that any engine can do it: what is
called is a function of a module, and what it takes and gives can be pickled.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import active_children, get_context
from types import TracebackType
from typing import ParamSpec, TypeVar

from slipid.support.errors import DataError
from slipid.support.progress import Reporter

Given = TypeVar("Given")
Result = TypeVar("Result")
Words = ParamSpec("Words")


class InProcess(Executor):
    """This process, which does the work as it is given."""

    def submit(
        self, fn: Callable[Words, Result], /, *args: Words.args, **kwargs: Words.kwargs
    ) -> Future[Result]:
        done: Future[Result] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class Processes(ProcessPoolExecutor):
    """Processes of this machine, started as there is work, which an interrupt or a kill ends.

    Forked processes would inherit the threads of whatever the caller has loaded.
    """

    def __init__(self, jobs: int) -> None:
        super().__init__(jobs, get_context("spawn"), _work_for, (os.getpid(),))
        self._others = set(active_children())

    def submit(
        self, fn: Callable[Words, Result], /, *args: Words.args, **kwargs: Words.kwargs
    ) -> Future[Result]:
        with _deaf():  # Ctrl-C is for this process, from the start of the others on
            return super().submit(fn, *args, **kwargs)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Wait for the work, or after an error end it: files come whole, so half is nothing yet."""
        self.shutdown(wait=error is None, cancel_futures=True)
        for child in set(active_children()) - self._others:
            child.terminate()


def results(
    executor: Executor,
    work: Callable[[Given], Result],
    todo: Mapping[str, Given],
    report: Reporter,
) -> list[Result]:
    """Results in the order in which they come, each of them reported.

    Args:
        executor: that does the work.
        work: a function of a module.
        todo: what it is called with, by name.

    Raises:
        DataError: a process was ended by the system.
    """
    found: list[Result] = []
    waiting: dict[Future[Result], str] = {}

    def collect(done: Iterable[Future[Result]]) -> None:
        for future in done:
            found.append(future.result())
            what = f"{len(found)} of {len(todo)}, {waiting.pop(future)}"
            report.advance(len(found), len(todo), what)

    try:
        for name, given in todo.items():
            waiting[executor.submit(work, given)] = name
            collect([future for future in waiting if future.done()])
        collect(as_completed(list(waiting)))
    except BrokenExecutor as error:
        raise DataError(
            "a process ended before its work did (memory?); called again, it goes on from there"
        ) from error
    return found


@contextmanager
def _deaf() -> Iterator[None]:
    """No interrupts; processes started meanwhile never hear any."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _work_for(parent: int) -> None:
    """Leave interrupts to the parent, and end when it has been killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
