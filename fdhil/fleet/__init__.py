"""Collects the records of many machines: sending (uplink), collecting (collector) and evaluating them (questions)."""
