"""Rows in blocks: the results of all rows at once, whatever their number."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.support.blocks import in_blocks

TRACED = []


@jax.jit
def of_rows(tree, factor):
    TRACED.append(factor.shape)
    return jnp.sin(tree["x"]) * factor[:, None], {"sum": tree["x"].sum(axis=1) + factor}


@pytest.mark.parametrize("rows", [1, 7, 8, 9, 20])
def test_blocks_give_what_all_rows_give_and_compile_once(rows):
    rng = np.random.default_rng(rows)
    x, factor = rng.normal(size=(rows, 3)), rng.normal(size=rows)
    first, second = in_blocks(of_rows, {"x": x}, factor, block=8)
    np.testing.assert_allclose(first, np.sin(x) * factor[:, None], rtol=1e-14)
    np.testing.assert_allclose(second["sum"], x.sum(axis=1) + factor, rtol=1e-14)
    assert set(TRACED) == {(8,)}
    assert len(TRACED) == 1
