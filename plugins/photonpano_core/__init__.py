"""First-party components: packed .npy captures, midpoint resampling, maximum-likelihood merging, interpolators."""
