"""What reports say and draw of peg transfer."""

from starjax.sim.tasks.base import Words

WORDS = Words(
    title="peg transfer",
    done="moved the block to its peg",
    strict="threaded on the target peg, released and at rest",
    loose="close to the target peg (SurRoL's test)",
    collided="touched board, peg or block with shaft or arm",
    nearly="block at its peg, but not threaded, released and at rest",
)


def outline(mj_model: object) -> tuple[()]:
    """Nothing yet."""
    return ()
