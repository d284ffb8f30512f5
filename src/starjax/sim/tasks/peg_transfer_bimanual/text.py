"""Phrases of peg transfer with two arms, for reports."""

from starjax.sim.tasks.peg_transfer import text

TEXT = text.TEXT._replace(
    title="bimanual peg transfer",
    done="handed the block over in the air and put it on its peg",
    strict="lifted by one tool, passed in the air, threaded on the target peg by the other, "
    "released and at rest, in time",
    nearly="block at its peg, but not passed in the air, or not threaded, released and at rest",
    collided="touched board, peg or block with shaft or arm, or shafts or arms touched",
    lost="the block was dropped",
)
outline = text.outline
