"""C99 code of estimator and controller, from what JAX has traced of them."""
