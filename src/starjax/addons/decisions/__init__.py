"""Networks of decisions in fewer GPU kernels, for one or a few robots."""
