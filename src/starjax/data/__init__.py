"""Demonstrations: on disk, as windows for training, normalised and augmented."""
