"""Parts of the ray caster: scene (host constants), shapes (rays), tiles (culling), shade (colour)."""
