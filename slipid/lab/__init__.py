"""What judges: test site, self test, trial, benchmark, published systems, the 2021 paper."""
