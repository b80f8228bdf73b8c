"""Pixel mathematics that several stages need: arrays in, arrays out."""
