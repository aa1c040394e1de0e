"""Fixtures of the tests of the sampler."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.infer.posterior.transport_map import learnt


@pytest.fixture(scope="session")
def bent():
    """Map learnt from draws with a parabola, a funnel, two long tails and shared numbers."""
    group = np.array([-1, -1, 0, 0, 0, 0, 1, 1, 1])
    x = np.random.default_rng(0).normal(size=(5000, 9))
    x[:, 3] += x[:, 2] ** 2
    x[:, 4] *= np.exp(0.5 * x[:, 2])
    x[:, 2] += x[:, 0]
    x[:, 8] = np.exp(0.5 * x[:, 8])
    x[:, [1, 6]] = np.log(np.abs(x[:, [1, 6]]))
    x[:, 7] = 0.5 * x[:, 7] + 3 * np.exp(x[:, 6])
    return learnt(x, 1250.0, np.eye(9), group), x
