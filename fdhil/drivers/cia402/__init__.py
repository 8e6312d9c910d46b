"""A CiA 402 drive as it is heard: its profile and EDS, and its PDOs decoded into samples."""
