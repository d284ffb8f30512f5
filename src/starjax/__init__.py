"""starjax: surgical trocar-adaptive diffusion policy, in JAX and MJX.

Importing the package imports nothing heavy: `starjax.rcm`, `starjax.sim` and the others load on
their own import, so that `--help` and configuration errors answer at once.
"""

__version__ = "0.2.0"

from starjax import moved

moved.install()
