"""Sampling of the posterior with several emcee ensembles, in coordinates learnt from draws."""

from slipid.support.extras import require


def require_packages() -> None:
    """Raise `MissingExtra` unless the packages are installed that sampling needs, some at its end.

    Call it before the modules of this package are imported that need them.
    """
    for module in ("emcee", "arviz_base", "arviz_stats", "h5netcdf"):
        require(module, "posterior", "the posterior")
