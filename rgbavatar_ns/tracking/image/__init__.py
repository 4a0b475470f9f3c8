"""A frame cut out for the dataset."""
