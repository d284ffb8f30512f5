"""Learners, one module per learner: options, their check, and the model's builder."""
