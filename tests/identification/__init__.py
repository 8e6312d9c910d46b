"""Tests of fdhil.identification."""
