"""nerfstudio's trainer, with checkpoints that can be relied on."""
