"""From recorded rapids to the six parameters, each with its standard deviation, or the reason why there is none."""
