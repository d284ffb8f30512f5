"""Versions of parts name a dataset; other code of an equal version is refused."""

import pytest

from starjax.core import errors
from starjax.data import store
from starjax.runtime import files

OLD = {"schema": store.SCHEMA, "seed": 0, "versions": {}, "source": {"starjax": "a"}}
NEW = OLD | {"parts": {"task reach": 1}, "source": {"task reach": "a"}}
EDITED = NEW | {"source": {"task reach": "b"}}
RAISED = EDITED | {"parts": {"task reach": 2}}


def test_a_dataset_of_another_version_is_another(tmp_path):
    assert store.digest(NEW) == store.digest(EDITED)
    assert len({store.digest(x) for x in (OLD, NEW, RAISED)}) == 3
    store.create(tmp_path, NEW)
    store.create(tmp_path, NEW)
    with pytest.raises(errors.UsageError) as refused:
        store.create(tmp_path, EDITED)
    assert refused.value.argument == "task reach"
    with pytest.raises(files.StorageError):
        store.create(tmp_path, RAISED)
