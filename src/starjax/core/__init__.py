"""Records, errors, registries and settings that every part of starjax uses."""
