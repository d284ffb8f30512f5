"""Phrases of needle hand-over, for reports."""

from starjax.tasks.needle_pick import text

TEXT = text.TEXT._replace(
    title="needle hand-over",
    done="handed the needle over in the air",
    strict="lifted by one tool, taken over in the air, and held for 2 s by the other alone without "
    "slipping by more than 0.5 mm, in time",
    loose="the other tool alone held the needle in the air, slipping or not",
    nearly="needle taken over, but it slipped or was not held for 2 s",
    collided="pressed jaws or shaft into the foam, or shafts or arms touched",
    goal="the needle must be handed over",
    lost="the needle was dropped",
)
outline = text.outline
