"""Every packaged drive profile against a simulated drive with the vendor's EDS."""
