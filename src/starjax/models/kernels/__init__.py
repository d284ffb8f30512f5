"""Variants of the networks for one kind of device, each equal to its reference."""
