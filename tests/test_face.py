"""The names that `starjax` hands out: few, lazy, documented with examples."""

import inspect
import subprocess
import sys

import pytest

import starjax
from starjax.core import errors, registry


def test_the_face_is_small():
    assert len(starjax.__all__) <= 12 and set(starjax.__all__) <= set(dir(starjax))


@pytest.mark.parametrize("name", starjax.__all__)
def test_a_name_is_what_it_says(name):
    found = getattr(starjax, name)
    assert inspect.getdoc(found)
    if name.isupper():
        assert isinstance(found, registry.Rows) and len(found) > 3
    elif inspect.isfunction(found):
        parts = inspect.getdoc(found)
        assert "Args:" in parts and found.__annotations__


def test_tables_and_modules_are_named_without_jax():
    program = (
        "import sys, starjax\n"
        "names = [*starjax.TASKS.registry.names(), *starjax.METHODS, *starjax.PRESETS]\n"
        "print(len(names) > 20, 'jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "True False", done.stderr


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'polcy'"):
        starjax.__getattr__("polcy")


def test_a_policy_refuses_an_environment_of_another_task():
    with pytest.raises(errors.UsageError, match="peg_transfer"):
        starjax.load_policy("compact", starjax.make_env("reach", image_size=128))
