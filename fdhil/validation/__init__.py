"""Validates windows: checks of the signals, of the fit, and of what the model leaves at the table.

No estimate is accepted unchecked. The checks never raise, whatever the signals; each refusal has a reason.
"""
