"""Every packaged drive profile against the twin in the dress of that drive."""
