"""Captures: one reader a format behind one ``Subject``; ray-traced synthetic captures."""
