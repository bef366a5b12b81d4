"""Find entries of a table of results that cannot be right, without knowing the right values."""
