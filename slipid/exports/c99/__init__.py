"""Generation of C99 code from functions that JAX has traced."""
