"""Geometry stage (Section 3.1): vertex-bound Gaussians and the refined mesh."""
