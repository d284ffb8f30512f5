"""Six blocks one after another, the exercise of FLS one way: a variant of the task.

Blocks are alike, so one body is the block to move, and five others stand still: visible, and
obstacles for shafts, but without contacts. Lengths in m.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.core.types import Pose
from starjax.sim.task import Capsules
from starjax.tasks.peg_transfer import task as single
from starjax.tasks.peg_transfer_bimanual import task

BLOCKS = 6
LIMIT_S = 300.0  # for FLS


@flax.struct.dataclass
class SixBlocksLayout:
    """Present block as in the task, and the whole exercise.

    Attributes:
      source, target, target_peg, block: of the present block, see `peg_transfer`.
      tips: `[2, 3]`, the tips at the start of its turn.
      sources, targets: `[6]` int32 pegs, in order.
      blocks: Pose `[6]` of all blocks.
      turn: int32, number of finished blocks.
      since: int32, the control step at the start of this turn.
    """

    source: jax.Array
    target: jax.Array
    target_peg: jax.Array
    block: Pose
    tips: jax.Array
    sources: jax.Array
    targets: jax.Array
    blocks: Pose
    turn: jax.Array
    since: jax.Array


def sample(bound: single.PegBound, key: jax.Array) -> SixBlocksLayout:
    """Draws the order, and as in the task every block's offset and yaw and the tips' start."""
    key_order, key_blocks = jax.random.split(key)
    keys = jax.random.split(key_blocks, BLOCKS)
    drawn = jax.vmap(lambda key: task.sample(bound, key))(keys)
    order = jax.vmap(jax.random.permutation, (0, None))(jax.random.split(key_order), BLOCKS)
    sources, targets = order[0], BLOCKS + order[1]
    pegs = jnp.asarray(bound.pegs)
    offset = drawn.block.p[:, :2] - pegs[drawn.source]
    p = drawn.block.p.at[:, :2].set(pegs[sources] + offset)
    zero, no = jnp.zeros((), jnp.int32), jnp.zeros((3,))
    layout = SixBlocksLayout(
        source=zero,
        target=zero,
        target_peg=no[:2],
        block=Pose(jnp.eye(3), no),
        tips=drawn.tips[0],
        sources=sources.astype(jnp.int32),
        targets=targets.astype(jnp.int32),
        blocks=Pose(drawn.block.R, p),
        turn=zero,
        since=zero,
    )
    return begin(bound, layout, zero, layout.tips, zero)


def begin(
    bound: single.PegBound,
    layout: SixBlocksLayout,
    turn: jax.Array,
    tips: jax.Array,
    step: jax.Array,
) -> SixBlocksLayout:
    """Returns the layout with another block's turn, starting from these tips and control step."""
    target = layout.targets[turn]
    return layout.replace(
        source=layout.sources[turn],
        target=target,
        target_peg=jnp.asarray(bound.pegs)[target],
        block=jax.tree.map(lambda x: x[turn], layout.blocks),
        tips=tips,
        turn=turn,
        since=step,
    )


def put(layout: SixBlocksLayout, block: Pose) -> SixBlocksLayout:
    """Returns the layout with the present block left at a pose."""
    blocks = jax.tree.map(lambda x, at: x.at[layout.turn].set(at), layout.blocks, block)
    return layout.replace(blocks=blocks)


def still(layout: SixBlocksLayout) -> Pose:
    """Returns the other blocks, Pose `[5]`."""
    others = (layout.turn + 1 + jnp.arange(BLOCKS - 1)) % BLOCKS
    return jax.tree.map(lambda x: x[others], layout.blocks)


def _obstacles(
    bound: single.PegBound, layout: SixBlocksLayout, measurements: task.BimanualMeasurements
) -> Capsules:
    """Returns the pegs and the walls of all blocks."""
    own = single.around(bound, measurements.block)
    others = jax.vmap(lambda block: single.around(bound, block))(still(layout))
    walls = (x[:, -single.WALLS :].reshape(-1, *x.shape[2:]) for x in others)
    return Capsules(*(jnp.concatenate(parts) for parts in zip(own, walls, strict=True)))


TASK = task.TASK._replace(
    mjcf="tasks/peg_transfer_bimanual/six_blocks.xml",
    time_limit_s=LIMIT_S,
    labels=("moved",),
    sample=sample,
    label=lambda layout: {"moved": layout.turn},
    obstacles=_obstacles,
    still=still,
)
