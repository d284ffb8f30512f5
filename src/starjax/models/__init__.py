"""Networks and diffusion. flax.linen lives here only, and nothing here knows a robot."""
