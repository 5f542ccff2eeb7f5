"""Formats of motion, one module each: ``recognises(path)`` and ``read(path)``; see :mod:`mgavatar.driving.read`."""
