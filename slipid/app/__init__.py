<<<<<<< ours
"""Configs, and what each command does."""
=======
"""What a config asks for."""
>>>>>>> theirs
