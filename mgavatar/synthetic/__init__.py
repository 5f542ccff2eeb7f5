"""Ray-traced synthetic captures with their ground truth."""
