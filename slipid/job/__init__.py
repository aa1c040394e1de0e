"""What a config asks for."""
