"""The command line with all commands.

Commands import their libraries when they run, so that `slipid --help` does not load numpy.
"""

import _thread
import sys
import threading

import typer

from slipid.cli.benchmark import benchmark, paper
from slipid.cli.calibrate import calibrate
from slipid.cli.check import check
from slipid.cli.demo import demo
from slipid.cli.design import design
from slipid.cli.export import export
from slipid.cli.export_run import export_run
from slipid.cli.floors import floors
from slipid.cli.identify import identify
from slipid.cli.map import map_
from slipid.cli.motor import motor
from slipid.cli.new import new, reference
from slipid.cli.sample import sample
from slipid.cli.selftest import selftest
from slipid.cli.simulate import simulate
from slipid.cli.track import track
from slipid.cli.trial import trial
from slipid.cli.validate import compare, validate

app = typer.Typer(
    name="slipid",
    help="Identify the motors, floor friction and wheel loads of a robot from its logs.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    *(new, reference, motor, check, selftest, identify, sample, validate, compare),
    *(design, trial, export, export_run, simulate, calibrate, track, map_, floors),
    *(paper, benchmark, demo),
):
    # strip the underscore of `map_`, which only keeps the name of Python's built-in map free
    app.command(command.__name__.rstrip("_").replace("_", "-"))(command)

AGAIN_S = 0.05
"""Delay before an interrupt that Python ignored is sent again [s]."""


def main() -> None:
    """Run the `slipid` command."""
    sys.unraisablehook = _interrupt_again
    app()


def _interrupt_again(lost: "sys.UnraisableHookArgs") -> None:
    """Send an interrupt again if Python ignored it.

    Python ignores an interrupt that arrives in a finaliser or in a callback of the garbage
    collector (jax has one), where no exception can be raised.
    """
    if lost.exc_type is KeyboardInterrupt:
        again = threading.Timer(AGAIN_S, _thread.interrupt_main)
        again.daemon = True  # so that the program can exit without waiting for the timer
        again.start()
    else:
        sys.__unraisablehook__(lost)
