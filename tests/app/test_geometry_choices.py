"""Parameters that a fit of the force balance frees after a calibration."""

import numpy as np
import pytest

from slipid.app.problem import geometry_choices
from slipid.fitting.calibration.result import Calibration, MotionNoise, Value
from tests.helpers.kinds import SHAPES


def value(number: float, verdict="identified") -> Value:
    return Value(number, (number, number), 0.001, verdict, "m")


def calibration(verdict="identified") -> Calibration:
    """A calibration on a floor into which wheels sink by 4 %, and on a firm one."""
    zero = (0.0, 0.0, 0.0)
    none = {"hard": zero, "soft": zero}
    return Calibration(
        sideways=False,
        radius={"hard": (value(0.1),) * 2, "soft": (value(0.096, verdict),) * 2},
        base={"hard": value(0.5), "soft": value(0.52)},
        centre={},
        offset=(value(0.0), value(0.0)),
        yaw=value(0.0),
        session_yaw={},
        lag=value(0.05),
        scale=value(1.0),
        firmest="hard",
        steering={},
        gyro={},
        nominal_radius=0.1,
        nominal_base=0.4,
        noise=MotionNoise(0.001, 0.001, none, none),
        runs=9,
        settled=True,
    )


@pytest.mark.parametrize("kind", SHAPES)
def test_rolling_radii_are_fitted_for_a_skid_steer_only(kind):
    found = geometry_choices(calibration(), SHAPES[kind], ())
    radii = {c.pattern: c for c in found if "rolling_radius" in c.pattern}
    assert list(radii) == (["surface.soft.rolling_radius"] if kind == "skid" else [])
    for choice in radii.values():
        assert choice.free
        assert choice.start == pytest.approx(np.log(0.96))


def test_a_radius_that_no_run_shows_stays_that_of_the_wheel():
    found = geometry_choices(calibration("not_identified"), SHAPES["skid"], ())
    assert not any("rolling_radius" in choice.pattern for choice in found)
