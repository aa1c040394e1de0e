"""Fixtures that several tests of the fit share."""

from __future__ import annotations

import jax
import pytest

from slipid.fitting import variances


@pytest.fixture
def gaussian(monkeypatch):
    """Residuals of runs are Gaussian; what was compiled for a Student t serves nobody then."""
    monkeypatch.setattr(variances, "DEGREES", 1e12)
    jax.clear_caches()
    yield
    jax.clear_caches()
