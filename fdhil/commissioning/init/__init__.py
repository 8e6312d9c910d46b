"""Create a configuration from the NC's own files, the drives' answers, the operator's answers and default guesses."""
