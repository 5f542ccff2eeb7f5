"""Appearance stage (Section 3.2): face-bound Gaussians, ColorNet and OffsetNet."""
