"""Executors of independent jobs: in this process, or in local processes that end with this one.

Functions that run independent jobs take a `concurrent.futures.Executor`, so that any executor can
run them. The function of a job is therefore at the top level of a module, and its arguments and
results can be pickled.
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
Arguments = ParamSpec("Arguments")


class InProcess(Executor):
    """Executor that runs each job in this process as it is submitted."""

    def submit(
        self, fn: Callable[Arguments, Result], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Result]:
        done: Future[Result] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class Processes(ProcessPoolExecutor):
    """Executor with processes on this machine, which are started on demand.

    The processes end when the process that started them is interrupted or killed. They are spawned,
    not forked, since forked processes would inherit the threads of the caller's libraries.
    """

    def __init__(self, jobs: int) -> None:
        super().__init__(jobs, get_context("spawn"), _end_with, (os.getpid(),))
        self._others = set(active_children())

    def submit(
        self, fn: Callable[Arguments, Result], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Result]:
        # processes that are started here ignore Ctrl-C, which then interrupts only this process
        with _interrupts_ignored():
            return super().submit(fn, *args, **kwargs)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Wait for the jobs, or terminate their processes after an error.

        Terminating them is safe, since files are written completely or not at all.
        """
        self.shutdown(wait=error is None, cancel_futures=True)
        for child in set(active_children()) - self._others:
            child.terminate()


def results(
    executor: Executor,
    work: Callable[[Given], Result],
    todo: Mapping[str, Given],
    report: Reporter,
) -> list[Result]:
    """Return the results of jobs in the order of their completion, and report the progress.

    Args:
        executor: executor of the jobs.
        work: function of a job, at the top level of a module.
        todo: argument of each job, keyed by the name of the job.
        report: reporter of the progress.

    Raises:
        DataError: a process was ended by the system before its job was finished.
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
            "a worker process ended before its job was finished (was there too little memory?); "
            "run the command again, which continues after the finished jobs"
        ) from error
    return found


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Return a context in which interrupts are ignored.

    Processes that are started in it ignore interrupts for their whole life.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _end_with(parent: int) -> None:
    """Set up a process that ignores interrupts and ends when its parent process has ended.

    `parent` is the id of the parent process.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
