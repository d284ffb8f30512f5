"""Add-ons: each folder brings what its `table` lists, and may be deleted; see `extensions`."""
