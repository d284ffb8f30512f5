"""A digest of the source in dataset.json: compared only where both descriptions have it."""

import pytest

from starjax.data import store
from starjax.runtime import files

OLD = {"schema": store.SCHEMA, "seed": 0, "versions": {}}
NEW = OLD | {"source": {"mylab": "a"}}
EDITED = OLD | {"source": {"mylab": "b"}}


def test_a_dataset_of_other_source_is_another(tmp_path):
    assert len({store.digest(x) for x in (OLD, NEW, EDITED)}) == 3
    store.create(tmp_path, NEW)
    store.create(tmp_path, NEW)
    store.create(tmp_path, OLD)
    with pytest.raises(files.StorageError):
        store.create(tmp_path, EDITED)


def test_a_dataset_without_it_is_used_as_before(tmp_path):
    folder = store.folder(tmp_path, NEW)
    assert folder == tmp_path / f"demos-{store.digest(NEW)}"
    older = tmp_path / f"demos-{store.digest(OLD)}"
    store.create(older, OLD)
    assert store.folder(tmp_path, NEW) == store.folder(tmp_path, EDITED) == older
    store.create(older, NEW)
