"""From what JAX has traced to text of C99."""
