"""A task and an arm from outside of starjax: what somebody else would write."""
