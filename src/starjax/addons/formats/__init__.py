"""Other people's dataset formats: rows of `base.FORMATS`, read and written as one struct."""
