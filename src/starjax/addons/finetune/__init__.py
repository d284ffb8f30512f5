"""Fine-tuning of a trained policy in the simulator."""
