"""Drive an avatar: motion, retargeting, cameras, and writers of images and video."""
