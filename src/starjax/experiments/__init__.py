"""What a person runs: the methods, the presets, the commands and the report."""
