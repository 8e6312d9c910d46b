"""Tests of fdhil.validation."""
