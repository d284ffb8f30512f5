"""Commands `starjax view` and `starjax teleop`."""
