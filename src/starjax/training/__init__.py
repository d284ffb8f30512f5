"""Training: state, step, loop, checkpoints, devices and the exported policy."""
