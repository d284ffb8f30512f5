"""Parts of starjax in a package of their own, one of each kind."""
