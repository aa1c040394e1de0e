"""Inference: fit results, verdicts, profiles, posteriors, proposals of runs, bench motors."""
