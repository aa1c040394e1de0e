"""C99 code generated from functions that JAX has traced."""
