"""Evaluation of slipid: test site, self test, trial, benchmark, published systems, 2021 paper."""
