"""Lowering of functions that JAX has traced to text of C99."""
