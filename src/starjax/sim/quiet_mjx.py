"""Imports MJX without its two lines about the absent CUDA engine, which it prints to stdout."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

__all__ = ["mjx"]
