"""The commands, and the presets that they begin with."""
