"""What figures draw of the task is where the compiled model has it."""

import numpy as np

from starjax.sim import scene
from starjax.tasks.peg_transfer import task, text


def test_the_outline_is_the_models():
    model = scene.compose(scene.name())
    drawn = text.outline(model)
    pegs = np.array([line[0, :2] for line in drawn.lines])
    np.testing.assert_allclose(pegs, [model.geom(f"peg{i}").pos[:2] for i in range(12)])
    assert {line[-1, 2].round(9) for line in drawn.lines} == {task.PEG_HEIGHT}
    for board, name in zip(drawn.areas, text.BOARDS, strict=True):
        geom = model.geom(name)
        np.testing.assert_allclose(np.ptp(board[:, :2], axis=0), 2 * geom.size[:2])
        np.testing.assert_allclose(board.mean(0)[:2], geom.pos[:2])
        assert not board[:, 2].any()
    source, target = drawn.areas
    assert (pegs[:6] > source.min(0)[:2]).all() and (pegs[6:] < target.max(0)[:2]).all()
