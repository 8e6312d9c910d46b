"""Tests of what the networks of a shop floor are told."""
