"""Contents of the files that later commands write beside a fit, as short as they may be."""

_SIZE = {"ensembles": 4, "walkers": 8, "steps": 72}
_SCORE = {"endpoint_error_over_path_mean": 0.1, "heading_error_median_deg": 1.0}
_SCORE |= {"coverage90": 0.9, "runs": 3}
_ERRORS = {"closure_error_median": 9.0, "cross_track_rmse": 5.0, "heading_error_deg": 1.0}
_DRIVEN = {"finished_share": 1.0, "runs": 3, "interval90": {"closure_error_median": [8.0, 10.0]}}
_PROPOSED = {"floor": "firm", "load": "as_built", "heading_deg": 30.0, "speed": 0.2}
_PROPOSED |= {"turn_rate": 0.1, "seconds": 5.0}
_RANKED = {"difference": -1.0, "se_clustered": 0.3, "endpoint_error": 0.05}
LATER = {
    "sample": {
        "converged": True,
        "reason": "",
        "worst": {"r_hat": 1.0, "effective_draws": 400.0},
        "posterior_sha256": "0" * 64,
        **_SIZE,
    },
    "validation": {"summary": {"soft": {"contact": _SCORE}}},
    "trial": {
        "summary": {"encoder": _ERRORS | _DRIVEN},
        "controllers": {"encoder": "by the wheels"},
        "verdict": "no difference",
        "path": "square",
        "speed_m_s": 0.2,
        "plant": "twin",
        "map": "patches",
    },
    "design": {"runs": [_PROPOSED], "messages": ["drive it twice"]},
}
"""Contents of the files of later commands, without the fit to which they belong."""
COMPARISON = {
    "questions": {
        "sectors": {"floors": {"firm": {"models": {"identified": _RANKED}, "sentence": "A leads."}}}
    }
}
"""Content of comparison.json, without the logs to which it belongs."""
