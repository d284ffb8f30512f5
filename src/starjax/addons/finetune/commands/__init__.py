"""Command `starjax finetune`."""
