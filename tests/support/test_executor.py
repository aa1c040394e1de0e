"""Executors return complete results, and errors end the remaining jobs."""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import pytest

from slipid.support.errors import DataError
from slipid.support.executor import InProcess, Processes, results
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

TODO = {f"number {k}": k for k in range(5)}


def square(k: int) -> int:
    return k * k


def where(_: int) -> int:
    return os.getpid()


def received(array: jax.Array) -> tuple[str, float]:
    return str(array.dtype), float(array)


def gone(_: int) -> int:
    os._exit(9)


def ends(k: int) -> int:
    if k == 0:
        raise ValueError("no root")
    time.sleep(60.0)
    return k


@pytest.mark.parametrize("engine", [InProcess, lambda: ThreadPoolExecutor(2)])
def test_any_executor_of_the_standard_library_does(engine):
    with engine() as executor:
        assert sorted(results(executor, square, TODO, Reporter(quiet=True))) == [0, 1, 4, 9, 16]
        assert results(executor, square, {}, Reporter(quiet=True)) == []


@pytest.mark.slow
def test_processes_are_others_and_a_dead_one_is_an_error():
    with Processes(2) as executor:
        assert os.getpid() not in results(executor, where, TODO, Reporter(quiet=True))
    setup_jax(quiet=True)
    with Processes(1) as executor:
        third = {"array": jnp.asarray(1 / 3)}
        assert results(executor, received, third, Reporter(quiet=True)) == [("float64", 1 / 3)]
    with (
        pytest.raises(DataError, match="a worker process ended before its job"),
        Processes(1) as executor,
    ):
        results(executor, gone, {"one": 1}, Reporter(quiet=True))


@pytest.mark.slow
def test_an_error_ends_the_processes_that_still_work():
    began = time.monotonic()
    with pytest.raises(ValueError, match="no root"), Processes(2) as executor:
        results(executor, ends, TODO, Reporter(quiet=True))
    assert time.monotonic() - began < 30.0
