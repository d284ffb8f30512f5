"""The methods of Table II: pure functions from observations to commands."""
