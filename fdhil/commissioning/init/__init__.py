"""From nothing to a configuration: what the NC's own files, the drives and the operator tell, and what is guessed."""
