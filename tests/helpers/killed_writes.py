"""Processes that die, or whose disk fills up, at the n-th step of writing files."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


class Killed(BaseException):
    """Stand-in for the death of a process."""


@contextmanager
def dies_at(step: int) -> Iterator[None]:
    """A context in which files are no longer written, renamed or deleted from a step on.

    A step is one file that is written, renamed or deleted. Each further one raises `Killed` as
    well, since a process that is dead does not clean up.
    """
    done = 0

    def until(call: Callable, counts: Callable[..., bool] = lambda *_: True) -> Callable:
        def run(*args, **more):
            nonlocal done
            done += counts(*args)
            if done > step:
                raise Killed
            return call(*args, **more)

        return run

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", until(os.fsync))
        patch.setattr(os, "replace", until(os.replace))
        patch.setattr(os, "unlink", until(os.unlink, lambda path, *_: Path(path).exists()))
        yield


@contextmanager
def disk_full_at(step: int) -> Iterator[None]:
    """A context in which the disk is full from the n-th file on."""
    done = 0

    def fill(_: int) -> None:
        nonlocal done
        done += 1
        if done > step:
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", fill)
        yield
