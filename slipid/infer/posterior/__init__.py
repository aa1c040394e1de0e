"""Sampling of the posterior, several emcee ensembles in learnt coordinates."""
