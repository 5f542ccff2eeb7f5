"""Head models in FLAME's schema: load, build, subdivide, pose."""
