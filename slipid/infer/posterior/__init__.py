"""Sampling of the posterior with several emcee ensembles, in coordinates learnt from draws."""
