"""Sources of performances that need no camera: files, phones and other programs."""
