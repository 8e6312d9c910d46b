"""Decodes the PDOs of CiA 402 drives into samples, by their profiles."""
