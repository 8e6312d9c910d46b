"""Studies: reproducible experiments on a simulated bench that shares no code with the package."""
