"""Image processing that several stages need: arrays in, arrays out."""
