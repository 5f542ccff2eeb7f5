"""Scores of an avatar: images, geometry, and naive baselines."""
