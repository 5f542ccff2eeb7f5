"""Drivable Gaussian head avatars on a personal mesh (MGAvatar)."""

__version__ = "0.1.0"
