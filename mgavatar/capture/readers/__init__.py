"""Readers of captures, one file per format."""
