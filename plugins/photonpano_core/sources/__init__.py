"""Sources of frames in .npy files, and in files without any description."""
