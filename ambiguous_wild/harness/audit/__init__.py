"""What cannot be right in a table of results, found without knowing the right answer."""
