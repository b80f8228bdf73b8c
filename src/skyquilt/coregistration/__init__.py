"""Registration of images of different spectral bands."""
