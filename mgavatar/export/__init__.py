"""Files for other programs: splats and meshes of an avatar."""
