"""Work spread over processes that an interrupt or a kill of the parent ends cleanly."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context
from typing import TypeVar

from slipid.support.errors import DataError
from slipid.support.progress import Reporter

Job = TypeVar("Job")
Result = TypeVar("Result")


def spread(
    work: Callable[[Job], Result],
    todo: Mapping[str, Job],
    jobs: int,
    report: Reporter,
    *,
    alone: bool = False,
) -> list[Result]:
    """Results of pieces of work in the order they are finished, each of them reported.

    Args:
        work: a function of a module, what it takes and gives can be pickled.
        todo: what it is called with, by name.
        jobs: processes at once, where there is as much to do.
        alone: with one job, in this process.

    Raises:
        DataError: a process was ended by the system.
    """
    found: list[Result] = []

    def tell(name: str, result: Result) -> None:
        found.append(result)
        report.advance(len(found), len(todo), f"{len(found)} of {len(todo)}, {name}")

    jobs = min(jobs, len(todo))
    if not todo or (alone and jobs == 1):
        for name, job in todo.items():
            tell(name, work(job))
        return found
    # forked processes would inherit the threads of whatever the caller has loaded
    others = set(active_children())
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _work_for, (os.getpid(),))
    try:
        with _deaf():  # Ctrl-C is for this process, from the start of the others on
            waiting = {pool.submit(work, job): name for name, job in todo.items()}
        for future in as_completed(waiting):
            tell(waiting[future], future.result())
        pool.shutdown()
    except BrokenProcessPool as error:
        raise DataError(
            "a process ended before its work did (memory?); called again, it goes on from there"
        ) from error
    finally:  # what is half done is nothing yet: files come whole
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(active_children()) - others:
            child.terminate()
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
