"""The relative roll network: future tip positions and the trocar give the roll (Eq. 13)."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.policies.models import layers


class RollNet(nn.Module):
    """A residual MLP from (positions, trocar, roll history) to the rolls of the horizon.

    It predicts the roll itself, as the paper does, not its change since the last measured one. Its
    last layer starts at zero: an untrained network predicts zero and not a random roll.
    Inputs should be of order one.

    Attributes:
      width: of the hidden layers.
      blocks: residual blocks (LayerNorm, Linear, GELU, Linear).
      embed_dim: width of the trocar's embedding.
      outputs: N, numbers per future position; 1 is the roll alone.
      dtype: of the arithmetic; parameters, LayerNorm statistics and the output are float32.
    """

    width: int = 256
    blocks: int = 3
    embed_dim: int = 64
    outputs: int = 1
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(
        self,
        p: jax.Array,
        trocar: jax.Array,
        roll_history: jax.Array,
        observed: jax.Array | None = None,
    ) -> jax.Array:
        """Computes Eq. 13: one roll for each future position.

        The paper's Embed(lambda) is a linear layer with GELU: the trocar is continuous, and a table
        of embeddings could not serve an unseen one.

        Args:
          p: `[B, H, n]` future tip positions (n = 3) or poses, normalised.
          trocar: `[B, F]` features of the trocar.
          roll_history: `[B, O * N]` measured rolls, in the unit of the output.
          observed: `[B, C]` features of the observation, an ablation; None in the paper.

        Returns:
          Rolls float32 `[B, H * N]`.
        """
        batch, horizon = p.shape[:2]
        # Embed(lambda)
        embedded = nn.gelu(layers.Dense(self.embed_dim, name="embed")(trocar.astype(self.dtype)))
        inputs = [p.reshape(batch, -1), embedded, roll_history]  # x_rel = [p, Embed(lambda), gamma]
        if observed is not None:
            inputs.append(observed)
        x = jnp.concatenate([part.astype(self.dtype) for part in inputs], -1)
        x = layers.residual_mlp(x, self.width, self.blocks, self.dtype)
        size = horizon * self.outputs
        # gamma_rel, t+1 .. t+H
        return layers.Dense(size, zero=True, name="out")(x).astype(jnp.float32)
