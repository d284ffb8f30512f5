"""The checks of an author's parts find no fault in starjax's own."""

import pytest

from starjax.testing import base, kinds

KINDS = ("arm", "tool", "learner", "encoder", "method", "action_space", "preset")
OWN = [(kind, name) for kind in KINDS for name in kinds.kinds()[kind].names()]


@pytest.mark.slow
@pytest.mark.release
@pytest.mark.parametrize(("kind", "name"), OWN)
def test_no_fault(kind, name):
    assert [check for check in kinds.run(kind, name, 1) if check.status == base.FAILED] == []
