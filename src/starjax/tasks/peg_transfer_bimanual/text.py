"""Phrases of peg transfer with two arms, for reports."""

from starjax.tasks.peg_transfer import text

TEXT = text.TEXT._replace(
    title="bimanual peg transfer",
    done="handed the block over in the air and put it on its peg",
    strict="lifted by one tool, passed in the air, threaded on the target peg by the other, "
    "released and at rest, in time",
    nearly="block at its peg, but not passed in the air, or not threaded, released and at rest",
    collided="touched the board, a peg or the block with a shaft or an arm, or the arms met",
    lost="the block was dropped",
)
outline = text.outline
