"""The mathematics of frames, cameras and transforms: numpy in, numpy out."""
