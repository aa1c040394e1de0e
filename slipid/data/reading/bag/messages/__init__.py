"""From the bytes of messages to arrays of numbers."""
