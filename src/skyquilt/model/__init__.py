"""The nouns: frozen records that flow from stage to stage. No I/O, no algorithms."""
