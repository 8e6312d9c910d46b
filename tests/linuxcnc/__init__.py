"""LinuxCNC as a whole, headless, for as long as a test needs it: orders go in, the demand of each cycle comes out."""
