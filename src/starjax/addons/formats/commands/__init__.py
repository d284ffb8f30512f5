"""Commands `starjax export` and `starjax import`."""
