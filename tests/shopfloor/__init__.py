"""Tests of the shop-floor publishers."""
