"""Fit an avatar to a capture: plan, budget, views, loop and the files of a run."""
