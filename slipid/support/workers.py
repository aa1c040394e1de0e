"""Work spread over processes that an interrupt or a kill of the parent ends cleanly."""

import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context
from typing import TypeVar

from slipid.support.errors import DataError

Job = TypeVar("Job")
Result = TypeVar("Result")


def spread(
    work: Callable[[Job], Result], todo: Sequence[Job], jobs: int, *, alone: bool = False
) -> Generator[tuple[Job, Result], None, None]:
    """Pieces of work and their results, in the order they are finished; to be closed.

    Args:
        work: a function of a module, what it takes and gives can be pickled.
        todo: what it is called with.
        jobs: processes at once.
        alone: with one job, in this process.

    Raises:
        DataError: a process was ended by the system.
    """
    if alone and jobs <= 1:
        yield from ((job, work(job)) for job in todo)
        return
    # forked processes would inherit the threads of whatever the caller has loaded
    others = set(active_children())
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _work_for, (os.getpid(),))
    try:
        with _deaf():  # Ctrl-C is for this process, from the start of the others on
            waiting = {pool.submit(work, job): job for job in todo}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
        pool.shutdown()
    except BrokenProcessPool as error:
        raise DataError(
            "a process ended before its work did (memory?); called again, it goes on from there"
        ) from error
    finally:  # what is half done is nothing yet: files come whole
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(active_children()) - others:
            child.terminate()


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
