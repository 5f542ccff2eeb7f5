"""``mgavatar bench``: what the kernels, the stages and the accuracy cost on this machine."""
