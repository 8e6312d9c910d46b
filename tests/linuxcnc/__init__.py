"""A complete headless LinuxCNC for the duration of a test: orders go in, the demand of each cycle comes out."""
