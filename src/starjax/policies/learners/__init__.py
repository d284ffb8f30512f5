"""One module a learner: its options, their check, and what makes its model."""
