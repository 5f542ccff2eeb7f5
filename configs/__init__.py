"""Presets: each ``.toml`` lists only what differs from the paper's defaults in ``mgavatar/config.py``."""
