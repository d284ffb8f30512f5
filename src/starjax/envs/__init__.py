"""Tasks as environments for reinforcement learning: Gymnasium's, and MuJoCo Playground's shape.

>>> import gymnasium, starjax.envs
>>> env = gymnasium.make("starjax/PegTransfer-v0", trocar="unseen", action_space="rcm4")

Gymnasium reads no entry points, so the module is imported, by hand or in the name:
`gymnasium.make("starjax.envs:starjax/PegTransfer-v0")`. The add-on
`playground` needs no Gymnasium.
"""

import importlib.util

from starjax.envs import registration

if importlib.util.find_spec("gymnasium"):
    registration.register()
